"""Processes that do not outlive the one that started them."""

import contextlib
import ctypes
import os
import signal
import sys

PARENT = "OCTASPLAT_PARENT_PID"
_PR_SET_PDEATHSIG = 1


def die_with(parent_pid: int, how: signal.Signals) -> None:
    """Ask Linux to send this process ``how`` when its parent dies; ends it at once if that has happened."""
    if sys.platform.startswith("linux"):
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, how, 0, 0, 0)
    if os.getppid() != parent_pid:
        os._exit(70)


def die_with_server() -> None:
    """As :func:`die_with`, in good order, for processes that ``octasplat serve`` starts."""
    parent = os.environ.pop(PARENT, "")
    if parent.isdigit():
        die_with(int(parent), signal.SIGTERM)
