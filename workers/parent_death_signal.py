"""Processes that do not outlive the one that started them."""

import contextlib
import os
import signal

from octasplat.workers.sandbox.linux import PR_SET_PDEATHSIG, prctl

PARENT_PID_VARIABLE = "OCTASPLAT_PARENT_PID"


def set_parent_death_signal(parent_pid: int, signal_: signal.Signals) -> None:
    """Ask Linux to send this process ``signal_`` when its parent dies, or now if it has died already."""
    with contextlib.suppress(OSError):
        prctl(PR_SET_PDEATHSIG, signal_)
    if os.getppid() != parent_pid:
        os._exit(70)


def die_with_local_service() -> bool:
    """Ask for SIGTERM when ``octasplat serve`` dies; return whether it started this process."""
    parent = os.environ.pop(PARENT_PID_VARIABLE, "")
    if parent.isdigit():
        set_parent_death_signal(int(parent), signal.SIGTERM)
    return parent.isdigit()
