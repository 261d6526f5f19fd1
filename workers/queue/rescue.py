"""Jobs whose worker was lost go to another one."""

import logging
import time
import uuid
from collections.abc import Sequence
from datetime import datetime

from psycopg.rows import class_row

from octasplat.workers.queue.attempts import rescue
from octasplat.workers.queue.jobs import get_job, queue_again
from octasplat.workers.queue.port import Slips
from octasplat.workers.records.database import Pool, naming
from octasplat.workers.records.locks import about_to_lock_jobs
from octasplat.workers.records.rows import Job

logger = logging.getLogger(__name__)


class Suspects:
    """Attempts that were not heard of for long by the database's clock, and for how long that is known here.

    That clock may jump, as on a laptop that slept, and then nobody was heard of for long. So only those are
    lost that are still not heard of a while later, by a clock that does not jump. After a jump back the last
    word of a lost worker lies in the future; it is silent too.

    Args:
        wait_seconds: how long that is; by then every worker that lives was heard of.
    """

    def __init__(self, wait_seconds: float) -> None:
        self._wait_seconds = wait_seconds
        self._since: dict[tuple[uuid.UUID, int, datetime | None], float] = {}

    def lost(self, silent: Sequence[Job]) -> list[Job]:
        """Those of the silent that did not change since they were seen first, long enough ago."""
        now = time.monotonic()
        found = {(job.id, job.attempt, job.heartbeat_at): job for job in silent}
        self._since = {key: self._since.get(key, now) for key in found}
        return [job for key, job in found.items() if now - self._since[key] >= self._wait_seconds]


async def rescue_lost_jobs(pool: Pool, slips: Slips, stale_seconds: float, suspects: Suspects) -> int:
    """Queue again whatever has not been heard of for ``stale_seconds`` by the database's clock.

    Safe to run anywhere at any time, also twice at once.

    Args:
        pool: connections.
        slips: the queue.
        stale_seconds: how long.
        suspects: those of the last time.

    Returns:
        Number of jobs that were taken from lost workers.
    """
    async with pool.connection() as connection:
        async with connection.transaction(), connection.cursor(row_factory=class_row(Job)) as cursor:
            await about_to_lock_jobs(connection)
            await cursor.execute(
                naming(
                    """
                SELECT {} FROM jobs
                WHERE state IN ('running', 'canceling')
                  AND NOT heartbeat_at BETWEEN now() - make_interval(secs => %(stale)s)
                    AND now() + make_interval(secs => %(stale)s)
                ORDER BY id FOR UPDATE SKIP LOCKED
                """,
                    Job,
                ),
                {"stale": stale_seconds},
            )
            lost = suspects.lost(await cursor.fetchall())
            for job in lost:
                logger.warning("worker %s was lost with job %s", job.worker, job.id)
                message = (
                    f"The worker {job.worker} was not heard of for {stale_seconds:g} s: it was killed, froze "
                    "or lost the database."
                )
                await rescue(connection, slips, job, {"type": "worker_lost", "message": message})
        async with connection.transaction():
            for job_id in await slips.lost(connection):
                again = await get_job(connection, job_id, lock=True)
                if again is not None and again.state == "queued":
                    logger.warning("job %s had no slip in the queue and got a new one", job_id)
                    await queue_again(connection, slips, again)
    return len(lost)
