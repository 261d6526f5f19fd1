"""Protection of processes that hold secrets: no other process reads their memory, even of the same user."""

import contextlib
import resource

from octasplat.workers.sandbox.linux import PR_SET_DUMPABLE, prctl


def forbid_memory_access() -> None:
    """Forbid other processes of this user to read this one's memory and environment, and core dumps."""
    with contextlib.suppress(OSError):
        prctl(PR_SET_DUMPABLE, 0)
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
