"""COLMAP's Python binding, loaded so that the program keeps its signals.

``import pycolmap`` takes SIGTERM and the signals of crashes for the whole process, to print a stack trace: a
handler that the program has set before is then not called any more, though Python still names it. So a
training that is to end at a checkpoint when its machine is taken away would die at once. Import it so::

    from octasplat.engine.core.colmap_binding import pycolmap

It is loaded when something of it is first asked for, as most commands never do.
"""

import ctypes
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any

_TAKEN = (
    signal.SIGTERM,
    signal.SIGSEGV,
    signal.SIGABRT,
    signal.SIGBUS,
    signal.SIGFPE,
    signal.SIGILL,
)
"""What it takes."""
_ACTION_BYTES = 512
"""More than the system's ``struct sigaction`` has on any machine (152 with glibc on x86-64)."""


@contextmanager
def _kept_signal_actions() -> Iterator[None]:
    """Give the signals back to whom they belonged before the block.

    By the C library, as Python sets handlers in its main thread only, and does not know those of others.
    """
    sigaction = ctypes.CDLL(None).sigaction
    before = {number: ctypes.create_string_buffer(_ACTION_BYTES) for number in _TAKEN}
    known = [number for number, action in before.items() if sigaction(int(number), None, action) == 0]
    try:
        yield
    finally:
        for number in known:
            sigaction(int(number), before[number], None)


class _Binding:
    """Stands for the binding, and loads it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()

    def __getattr__(self, name: str) -> Any:
        # One thread at a time: another would take the signals' actions for the program's.
        with self._lock, _kept_signal_actions():
            value = getattr(import_module("pycolmap"), name)
        # found without this method from now on
        setattr(self, name, value)
        return value


if TYPE_CHECKING:
    import pycolmap
else:
    pycolmap = _Binding()

__all__ = ["pycolmap"]
