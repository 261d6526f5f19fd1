"""Results of threads in order, of which only a few wait in memory."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")


def read_ahead(read: Callable[[T], R], items: Iterable[T], pool: Executor, most: int) -> Iterator[R]:
    """Yield ``read`` of each item, in order, as ``pool.map`` does.

    That one keeps all results that nobody has taken yet.

    Args:
        read: runs in the pool; what it raises is raised here.
        items: what is read.
        pool: the threads.
        most: so many items are under way or wait, at most; 1 at least.
    """
    waiting: deque[Future[R]] = deque()
    for item in items:
        waiting.append(pool.submit(read, item))
        if len(waiting) >= most:
            yield waiting.popleft().result()
    while waiting:
        yield waiting.popleft().result()
