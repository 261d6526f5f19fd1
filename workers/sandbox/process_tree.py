"""Ends a process's descendants, also those that have left its session and lost their parents.

Where a process is a subreaper (Linux), whatever its descendants leave behind becomes its own child.
"""

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import psutil


def kill_descendants(pid: int) -> int:
    """Kill the descendants of a process, each as soon as it is seen; return how many were seen."""
    count = 0
    for descendant in _descendants(pid):
        count += 1
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.kill(descendant, signal.SIGKILL)
    return count


def tree_memory_bytes(pid: int) -> int:
    """Return the memory of a process and its descendants that no file holds.

    Memory that they share counts for each of them, also where it lies in ``/dev/shm``. Pages of mapped files,
    as those of photographs, belong to the system, which takes them back when it needs them.

    Raises:
        PermissionError: the process is there and hidden.
    """
    tree = _tree(pid)
    if not tree:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, 0)
            raise PermissionError(f"/proc hides the process {pid}, so its memory cannot be measured")
    total = 0
    for process in tree:
        with contextlib.suppress(psutil.Error, OSError, ValueError):
            total += _memory_bytes(process)
    return total


def descendant_count(pid: int) -> int:
    """Return the number of live descendants of a process."""
    return max(0, len(_tree(pid)) - 1)


def _tree(pid: int) -> list[psutil.Process]:
    try:
        first = psutil.Process(pid)
        return [first, *first.children(recursive=True)]
    except (psutil.Error, OSError):
        return []


def _memory_bytes(process: psutil.Process) -> int:
    status = Path(f"/proc/{process.pid}/status")
    if not status.exists():
        memory = process.memory_info()
        return int(memory.rss - getattr(memory, "shared", 0))
    # Readable of other users' processes too, unlike the sums that count shared memory once.
    lines = (line.split() for line in status.read_text(encoding="utf-8", errors="replace").splitlines())
    counted = ("RssAnon:", "RssShmem:", "VmSwap:")
    return 1024 * sum(int(words[1]) for words in lines if words and words[0] in counted)


def _descendants(pid: int) -> Iterator[int]:
    """Yield the ids of descendants while they are looked for, as some may be gone a moment later.

    Those of each come before it. They may be a chain that is longer than the interpreter's stack.
    """
    # Asked of this process, as others may be hidden; there is none on other systems and some kernels.
    if not Path(f"/proc/self/task/{os.getpid()}/children").exists():
        with contextlib.suppress(psutil.Error, OSError):
            yield from (process.pid for process in psutil.Process(pid).children(recursive=True))
        return
    path = [(pid, iter(_children(pid)))]
    while path:
        parent, rest = path[-1]
        child = next(rest, None)
        if child is not None:
            path.append((child, iter(_children(child))))
            continue
        path.pop()
        if path:
            yield parent


def _children(pid: int) -> list[int]:
    """Return the ids of a process's children; none where it is hidden, or gone."""
    found: list[int] = []
    for thread in _threads(pid):
        with contextlib.suppress(OSError):
            found += map(int, Path(f"/proc/{pid}/task/{thread}/children").read_text(encoding="ascii").split())
    return found


def _threads(pid: int) -> list[str]:
    with contextlib.suppress(OSError):
        return os.listdir(f"/proc/{pid}/task")  # noqa: PTH208 - names are all that is asked for
    return []
