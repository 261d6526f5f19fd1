"""Heartbeats of a worker for one attempt, and the clock that runs between them."""

import asyncio
import contextlib
import time
from collections.abc import Callable

import psycopg
from psycopg_pool import PoolTimeout

from octasplat.workers.queue.attempts import Attempt
from octasplat.workers.settings import WorkerSettings

LOST_FRACTION = 2 / 3
"""A worker that could not write for this share of the stale limit stops its child before others take over."""
KILL_FRACTION = 0.9
"""A child that has not stopped by this share of the stale limit is killed."""
DATABASE_ERRORS = (
    psycopg.OperationalError, psycopg.InterfaceError, psycopg.errors.IdleInTransactionSessionTimeout,
    PoolTimeout, TimeoutError, OSError,
)  # fmt: skip


class Heartbeat:
    """Tells whether an attempt is certainly still this worker's.

    Only a heartbeat that this worker wrote counts, from the moment at which it was sent: others judge by the
    time in the row, which is no earlier. A successful read of the row proves nothing.

    Args:
        attempt: the claimed job.
        settings: of the worker.
        claimed_at: when the claim was requested, by ``time.monotonic()``.
    """

    def __init__(self, attempt: Attempt, settings: WorkerSettings, claimed_at: float) -> None:
        self._attempt = attempt
        self._settings = settings
        self._last_sent = claimed_at
        self._answered = asyncio.Event()

    @property
    def is_lost(self) -> bool:
        """Return whether other workers may soon take the job."""
        return time.monotonic() - self._last_sent > LOST_FRACTION * self._settings.stale_seconds

    @property
    def kill_at(self) -> float:
        """Return when the job's processes must have ended here, by ``time.monotonic()``."""
        return self._last_sent + KILL_FRACTION * self._settings.stale_seconds

    async def run(self, on_state: Callable[[str], None]) -> None:
        """Write heartbeats for ever, and pass the job's state to ``on_state``.

        Raises:
            FencedError: the job has gone on without this worker.
        """
        settings = self._settings
        while True:
            await asyncio.sleep(settings.poll_seconds)
            sent = time.monotonic()
            beats = sent >= self._last_sent + settings.heartbeat_seconds
            try:
                # Where packets vanish, psycopg gives up 10 s later at most, so this task does nothing else.
                async with asyncio.timeout(settings.heartbeat_seconds):
                    state = await (self._attempt.heartbeat() if beats else self._attempt.read_state())
            except DATABASE_ERRORS:
                # Whether the attempt is lost is decided by the clock, in wait_until_lost.
                continue
            self._answered.set()
            if beats:
                self._last_sent = sent
            on_state(state)

    async def wait_until_lost(self) -> None:
        """Return when contact is lost, by the clock alone, whatever the database does meanwhile."""
        settings = self._settings
        tick = min(settings.poll_seconds, settings.stale_seconds / 20)
        while True:
            slept = time.monotonic()
            await asyncio.sleep(tick)
            if time.monotonic() - slept > tick + settings.poll_seconds:
                # This process was frozen; the database may well answer, and then knows better.
                self._answered.clear()
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(2 * (settings.poll_seconds + settings.heartbeat_seconds)):
                        await self._answered.wait()
            if self.is_lost:
                return
