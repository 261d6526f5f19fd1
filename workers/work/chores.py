"""What a worker does regularly: watched, done again after any failure, or the worker ends."""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

from octasplat.workers.work.contact import DATABASE_ERRORS

logger = logging.getLogger(__name__)

FAILURES = 10
"""So many failures of a chore one after another, for no reason that will pass, end the worker."""
LATE_SECONDS = 600.0
"""A chore that has not ended after this time, or after ten times its interval, has failed."""


@dataclass(frozen=True)
class Chore:
    """Something to be done every ``seconds``; after ``late_seconds`` it is given up and done again."""

    do: Callable[[], Awaitable[None]]
    seconds: float
    late_seconds: float = LATE_SECONDS


class ChoreFailed(Exception):
    """A chore fails again and again, so that the worker had better be started anew."""


async def keep_doing(chore: Chore) -> None:
    """Do a chore for ever.

    Raises:
        ChoreFailed: it failed :data:`FAILURES` times in a row, and not because the database was away.
    """
    name = getattr(chore.do, "__name__", "a chore").strip("_")
    failures = 0
    while True:
        try:
            async with asyncio.timeout(max(chore.late_seconds, 10 * chore.seconds)):
                await chore.do()
            failures = 0
        except TimeoutError as error:
            failures += 1
            logger.error("%s did not end in time and is begun again: %s", name, error)
        except DATABASE_ERRORS as error:
            logger.info("%s has to wait: %s", name, error)
        except Exception as error:
            failures += 1
            logger.exception("%s failed and is done again", name)
            if failures >= FAILURES:
                raise ChoreFailed(f"{name} failed {failures} times in a row: {error}") from error
        await asyncio.sleep(chore.seconds)
