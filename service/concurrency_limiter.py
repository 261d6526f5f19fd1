"""Limits on how much work of a kind runs and waits at once."""

import asyncio
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from octasplat.service.problems import ProblemError

RETRY_SECONDS = 10


class ConcurrencyLimiter:
    """Limits concurrent work; further callers wait in order, up to a maximum.

    Args:
        noun: is done, in the plural, for the sentence.
        max_concurrent: how many are done at once.
        max_waiting: how many wait at most.
        max_per_owner: how many of one owner are done or wait.
    """

    def __init__(self, noun: str, *, max_concurrent: int, max_waiting: int, max_per_owner: int) -> None:
        self._noun = noun
        self._slots = asyncio.Semaphore(max_concurrent)
        self._max_admitted = max_concurrent + max_waiting
        self._max_per_owner = max_per_owner
        self._owners: Counter[str] = Counter()

    @asynccontextmanager
    async def limited(self, owner: str) -> AsyncIterator[None]:
        """Hold one of the places for the block.

        Raises:
            ProblemError: 429, with too many there.
        """
        if self._owners.total() >= self._max_admitted or self._owners[owner] >= self._max_per_owner:
            detail = f"Too many {self._noun} wait; repeat the request in a moment."
            raise ProblemError(429, "busy", detail, retry_seconds=RETRY_SECONDS)
        self._owners[owner] += 1
        try:
            async with self._slots:
                yield
        finally:
            self._owners[owner] -= 1
            if not self._owners[owner]:
                del self._owners[owner]
