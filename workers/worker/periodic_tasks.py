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
        PeriodicTaskError: it failed :data:`MAX_FAILURES` times in a row, and not for want of the database.
    """
    name = getattr(task.action, "__name__", "a periodic task").strip("_")
    failures = 0
    while True:
        try:
            async with asyncio.timeout(max(task.timeout_seconds, 10 * task.interval_seconds)):
                await task.action()
            failures = 0
        # Before DATABASE_ERRORS, which TimeoutError is among.
        except TimeoutError as error:
            failures += 1
            logger.error("%s did not end in time and is begun again: %s", name, error)
        except DATABASE_ERRORS as error:
            logger.info("%s has to wait: %s", name, error)
        except Exception as error:
            failures += 1
            logger.exception("%s failed and is done again", name)
            if failures >= MAX_FAILURES:
                raise PeriodicTaskError(f"{name} failed {failures} times in a row: {error}") from error
        await asyncio.sleep(task.interval_seconds)
