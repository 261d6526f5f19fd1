"""SIGINT and SIGTERM as requests to stop, so that a run can write a checkpoint first."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_SHOW_CURSOR = b"\x1b[?25h"


class StoppedError(Exception):
    """The user stopped the command; the text is the message, ``exit_code`` the code to return."""

    def __init__(self, message: str, exit_code: int) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class StopFlag:
    """Flag that is set when the user asks to stop, with the signal."""

    def __init__(self) -> None:
        self.signal_number: int | None = None

    def __call__(self) -> bool:
        """Return whether a signal was received."""
        return self.signal_number is not None

    @property
    def exit_code(self) -> int:
        """Return the exit code of a program ended by the signal: 130 for SIGINT, 143 for SIGTERM."""
        return 128 + (self.signal_number or signal.SIGINT)


@contextmanager
def request_stop_on_signals() -> Iterator[StopFlag]:
    """Inside the block, a first SIGINT or SIGTERM only sets the flag; a second one kills at once.

    Outside of the main thread, where Python allows no handlers, the flag just stays unset.
    """
    flag = StopFlag()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return

    def first(number: int, _frame: FrameType | None) -> None:
        flag.signal_number = number
        # The system's own action needs no interpreter, which may be busy in compiled code for long.
        for each in SIGNALS:
            signal.signal(each, signal.SIG_DFL)
        # The second signal leaves no time to do this. Not by way of a stream, which may be in use right now.
        if sys.__stdout__ is not None and sys.__stdout__.isatty():
            os.write(sys.__stdout__.fileno(), _SHOW_CURSOR)

    before = {number: signal.signal(number, first) for number in SIGNALS}
    try:
        yield flag
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def exit_on_sigterm() -> Iterator[None]:
    """Inside the block, SIGTERM unwinds the program (exit code 143), so that unfinished files are removed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def leave(number: int, _frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
