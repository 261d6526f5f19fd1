"""Thread limits of the libraries below: numba's kernels, torch, and Embree through the tracer."""

import os
from collections.abc import Iterator
from contextlib import contextmanager


def available_threads() -> int:
    """Return the most threads that can be used: ``NUMBA_NUM_THREADS``, or the cores of this process."""
    limit = os.environ.get("NUMBA_NUM_THREADS", "")
    if limit.isdigit() and int(limit) > 0:
        return int(limit)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def use_threads(threads: int) -> int:
    """Set how many threads numba's parallel kernels use when this thread calls them; 0 means all.

    Returns:
        The number that they take, which is never more than numba was started with.
    """
    import numba  # here, so that reading photographs alone does not wait for it

    most = int(numba.config.NUMBA_NUM_THREADS)
    count = min(threads, most) if threads > 0 else most
    numba.set_num_threads(count)
    return count


def threads_in_use() -> int:
    """Return how many threads kernels use when this thread calls them, as set by :func:`use_threads`."""
    import numba

    return int(numba.get_num_threads())


@contextmanager
def limit_torch_threads() -> Iterator[None]:
    """Limit torch to the calling thread, for work that is already parallel over photographs."""
    import torch  # here, as it takes a second and most work needs none of it

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
