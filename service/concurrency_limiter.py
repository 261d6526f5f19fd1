"""Limits on how much work of a kind runs and waits at once."""

import asyncio
from collections import Counter, deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from octasplat.service.problems import ProblemError

RETRY_SECONDS = 10


class ConcurrencyLimiter:
    """Limits concurrent work; further callers wait, up to a maximum.

    A free place goes to the waiting owner of whom the fewest are being done and who had one least recently,
    so that many of one owner keep nobody else waiting for longer than one of them takes.

    Args:
        noun: is done, in the plural, for the sentence.
        max_concurrent: how many are done at once.
        max_waiting: how many wait at most.
        max_per_owner: how many of one owner are done or wait.
    """

    def __init__(self, noun: str, *, max_concurrent: int, max_waiting: int, max_per_owner: int) -> None:
        self._noun = noun
        self._max_concurrent = max_concurrent
        self._running: Counter[str] = Counter()
        self._waiting: dict[str, deque[asyncio.Future[None]]] = {}
        self._served: dict[str, int] = {}
        self._turn = 0
        self._max_admitted = max_concurrent + max_waiting
        self._max_per_owner = max_per_owner
        self._owners: Counter[str] = Counter()

    @property
    def admitted_count(self) -> int:
        """Return how many are done or wait."""
        return self._owners.total()

    @asynccontextmanager
    async def limited(self, owner: str) -> AsyncIterator[None]:
        """Hold one of the places for the block.

        Raises:
            ProblemError: 429, with too many there.
        """
        if self.admitted_count >= self._max_admitted or self._owners[owner] >= self._max_per_owner:
            detail = f"Too many {self._noun} wait; repeat the request in a moment."
            raise ProblemError(429, "busy", detail, retry_seconds=RETRY_SECONDS)
        self._owners[owner] += 1
        try:
            await self._take_place(owner)
            try:
                yield
            finally:
                self._running[owner] -= 1
                self._give_places()
        finally:
            self._owners[owner] -= 1
            if not self._owners[owner]:
                del self._owners[owner], self._running[owner]
                self._served.pop(owner, None)

    async def _take_place(self, owner: str) -> None:
        """Wait for a place; it counts as running from the moment in which it is given."""
        place = asyncio.get_running_loop().create_future()
        self._waiting.setdefault(owner, deque()).append(place)
        self._give_places()
        try:
            await place
        except asyncio.CancelledError:
            if place.done() and not place.cancelled():  # given in the moment in which its caller left
                self._running[owner] -= 1
            else:
                self._forget(owner, place)
            self._give_places()
            raise

    def _give_places(self) -> None:
        while self._waiting and self._running.total() < self._max_concurrent:
            owner = min(self._waiting, key=lambda name: (self._running[name], self._served.get(name, 0)))
            place = self._waiting[owner][0]
            self._forget(owner, place)
            if not place.done():
                self._turn += 1
                self._served[owner] = self._turn
                self._running[owner] += 1
                place.set_result(None)

    def _forget(self, owner: str, place: "asyncio.Future[None]") -> None:
        if place in self._waiting.get(owner, ()):
            self._waiting[owner].remove(place)
            if not self._waiting[owner]:
                del self._waiting[owner]
