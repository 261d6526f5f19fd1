"""Protection of processes that hold secrets: no other process reads their memory, even of the same user."""

import contextlib
import re
import resource
from pathlib import Path

from octasplat.workers.sandbox.linux import PR_SET_DUMPABLE, prctl


def forbid_memory_access(*, is_measured: bool = False) -> None:
    """Forbid other processes of this user to read this one's memory and environment, and core dumps.

    Args:
        is_measured: whether another process measures this one, which holds no secrets. Where ``/proc`` hides
            what may not be read, only core dumps are forbidden then: a limit that nobody can check is none.
    """
    if not (is_measured and _hides_processes(Path("/proc/self/mountinfo"))):
        with contextlib.suppress(OSError):
            prctl(PR_SET_DUMPABLE, 0)
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))


def _hides_processes(mounts: Path) -> bool:
    """Return whether ``/proc`` is mounted with hidepid; ``mounts`` is as ``/proc/self/mountinfo``."""
    with contextlib.suppress(OSError):
        lines = mounts.read_text(encoding="utf-8", errors="replace").splitlines()
        # The fifth word is where it is mounted; of several mounts at one place the last one counts.
        of_proc = [line for line in lines if line.split()[4:5] == ["/proc"]]
        return bool(of_proc) and re.search(r"\bhidepid=(?!0|off)", of_proc[-1]) is not None
    return False
