"""Periodic tasks of a worker: restarted after a failure, or the worker ends."""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from octasplat.workers.worker.heartbeat import DATABASE_ERRORS

logger = logging.getLogger(__name__)

MAX_FAILURES = 10
"""So many failures of a periodic task one after another, for no reason that will pass, end the worker."""
DEFAULT_TIMEOUT_SECONDS = 600.0
"""A periodic task that has not ended after this time, or after ten times its interval, has failed."""


@dataclass(frozen=True)
class PeriodicTask:
    """An action to run every ``interval_seconds``; cancelled after ``timeout_seconds`` and run again."""

    action: Callable[[], Awaitable[None]]
    interval_seconds: float
    timeout_seconds: float = DEFAULT_TIMEOUT_SECONDS


class PeriodicTaskError(Exception):
    """A periodic task failed repeatedly, so that the worker should be restarted."""


async def run_periodically(task: PeriodicTask) -> None:
    """Run a task for ever.

    Raises:
        PeriodicTaskError: it failed or did not end in time :data:`MAX_FAILURES` times in a row, and not for
            want of the database.
    """
    name = getattr(task.action, "__name__", "a periodic task").strip("_")
    failures = 0
    while True:
        limit = asyncio.timeout(max(task.timeout_seconds, 10 * task.interval_seconds))
        try:
            async with limit:
                await task.action()
            failures = 0
        except Exception as error:
            # DATABASE_ERRORS have TimeoutError among them, which is the limit's error too.
            if isinstance(error, DATABASE_ERRORS) and not limit.expired():
                logger.info("%s has to wait: %s", name, error)
            else:
                failures += 1
                what = "did not end in time" if limit.expired() else "failed"
                logger.exception("%s %s and is begun again", name, what)
                if failures >= MAX_FAILURES:
                    raise PeriodicTaskError(f"{name} {what} {failures} times in a row: {error}") from error
        await asyncio.sleep(task.interval_seconds)
