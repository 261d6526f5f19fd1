"""Processes that do not outlive the one that started them."""

import contextlib
import os
import signal

from octasplat.workers.isolation.kernel import PR_SET_PDEATHSIG, prctl

PARENT = "OCTASPLAT_PARENT_PID"


def die_with(parent_pid: int, how: signal.Signals) -> None:
    """Ask Linux to send this process ``how`` when its parent dies; ends it at once if that has happened."""
    with contextlib.suppress(OSError):
        prctl(PR_SET_PDEATHSIG, how)
    if os.getppid() != parent_pid:
        os._exit(70)


def die_with_server() -> bool:
    """As :func:`die_with`, in good order, if ``octasplat serve`` has started this; returns whether it has."""
    parent = os.environ.pop(PARENT, "")
    if parent.isdigit():
        die_with(int(parent), signal.SIGTERM)
    return parent.isdigit()
