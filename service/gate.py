"""Work of which only so much is done at once and only so much waits."""

import asyncio
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from octasplat.service.problems import Problem

RETRY_SECONDS = 10


class Gate:
    """Lets in a few at a time; the others wait in the order in which they came, if they are not too many.

    Args:
        what: is done, in the plural, for the sentence.
        at_once: how many are done at once.
        waiting: how many wait at most.
        of_one_owner: how many of one owner are done or wait.
    """

    def __init__(self, what: str, *, at_once: int, waiting: int, of_one_owner: int) -> None:
        self._what = what
        self._free = asyncio.Semaphore(at_once)
        self._most = at_once + waiting
        self._of_one_owner = of_one_owner
        self._owners: Counter[str] = Counter()

    @asynccontextmanager
    async def passed(self, owner: str) -> AsyncIterator[None]:
        """For as long as the block runs, one of those that are done.

        Raises:
            Problem: 429, with too many there.
        """
        if self._owners.total() >= self._most or self._owners[owner] >= self._of_one_owner:
            detail = f"Too many {self._what} wait; repeat the request in a moment."
            raise Problem(429, "busy", detail, retry_seconds=RETRY_SECONDS)
        self._owners[owner] += 1
        try:
            async with self._free:
                yield
        finally:
            self._owners[owner] -= 1
            if not self._owners[owner]:
                del self._owners[owner]
