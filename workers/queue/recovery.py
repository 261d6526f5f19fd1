"""Jobs whose worker was lost go to another one."""

import logging
import time
import uuid
from collections.abc import Sequence
from datetime import datetime

from psycopg.rows import class_row

from octasplat.workers.db.connections import Pool, with_columns
from octasplat.workers.db.locks import about_to_lock_jobs
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.attempts import recover_attempt
from octasplat.workers.queue.jobs import get_job, requeue_job
from octasplat.workers.queue.protocol import JobQueue

logger = logging.getLogger(__name__)


class StalledAttempts:
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

    def confirm(self, stale: Sequence[Job]) -> list[Job]:
        """Return those of the silent that did not change since they were seen first, long enough ago."""
        now = time.monotonic()
        found = {(job.id, job.attempt, job.heartbeat_at): job for job in stale}
        self._since = {key: self._since.get(key, now) for key in found}
        return [job for key, job in found.items() if now - self._since[key] >= self._wait_seconds]


async def recover_stalled_jobs(
    pool: Pool, job_queue: JobQueue, stale_seconds: float, stalled: StalledAttempts
) -> int:
    """Queue again whatever has not been heard of for ``stale_seconds`` by the database's clock.

    Safe to run anywhere at any time, also twice at once.

    Args:
        pool: connections.
        job_queue: the queue.
        stale_seconds: how long.
        stalled: those of the last time.

    Returns:
        Number of jobs that were taken from lost workers.
    """
    async with pool.connection() as connection:
        async with connection.transaction(), connection.cursor(row_factory=class_row(Job)) as cursor:
            await about_to_lock_jobs(connection)
            await cursor.execute(
                with_columns(
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
            lost = stalled.confirm(await cursor.fetchall())
            for job in lost:
                logger.warning("worker %s was lost with job %s", job.worker, job.id)
                message = (
                    f"The worker {job.worker} was not heard of for {stale_seconds:g} s: it was killed, froze "
                    "or lost the database."
                )
                await recover_attempt(connection, job_queue, job, {"type": "worker_lost", "message": message})
        async with connection.transaction():
            for job_id in await job_queue.orphaned_jobs(connection):
                again = await get_job(connection, job_id, lock=True)
                if again is not None and again.state == "queued":
                    logger.warning("job %s had no slip in the queue and got a new one", job_id)
                    await requeue_job(connection, job_queue, again)
    return len(lost)
