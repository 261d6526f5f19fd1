"""Memory limit of a job: its share of the memory of this machine or container."""

from pathlib import Path

import psutil

JOB_MEMORY_FRACTION = 0.85
"""Share of the memory that all jobs of a worker may use together; the rest is for everything else."""
_CGROUP_FILES = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)


def memory_limit_bytes(requested_bytes: int | None, slots: int) -> int | None:
    """Return the limit of each job's program; None means that there is none.

    Args:
        requested_bytes: what the settings say: a limit, 0 for none, or None for a share.
        slots: jobs that may run at once.
    """
    if requested_bytes is not None:
        return requested_bytes or None
    return int(JOB_MEMORY_FRACTION * total_memory_bytes() / max(1, slots))


def total_memory_bytes() -> int:
    """Return the memory of the machine, or the limit of its container."""
    total = psutil.virtual_memory().total
    for path in _CGROUP_FILES:
        try:
            total = min(total, int(path.read_text(encoding="ascii")))
        except (OSError, ValueError):  # not there, or "max"
            continue
    return int(total)
