"""Recovery of jobs whose worker was lost."""

import logging
import time
import uuid
from collections.abc import Sequence
from datetime import datetime

from psycopg.rows import class_row

from octasplat.workers.db.connections import Pool, select_columns
from octasplat.workers.db.locks import about_to_lock_jobs, try_lock_recovery
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.block_jobs import settle_root, unsettled_roots
from octasplat.workers.queue.job_endings import recover_attempt
from octasplat.workers.queue.jobs import get_job, requeue_job
from octasplat.workers.queue.protocol import JobQueue

logger = logging.getLogger(__name__)


class StalledAttempts:
    """Attempts without a recent heartbeat by the database's clock, and since when they are known here.

    The same holds for queued jobs without a queue entry: one that another worker is about to begin has none
    for a moment.

    That clock may jump, as on a laptop that slept, and then all heartbeats look old. So only attempts that
    still have no new heartbeat a while later, by a monotonic clock, are lost. After a jump back the last
    heartbeat of a lost worker is in the future; that counts as old too.

    Args:
        wait_seconds: how long that is; by then every live worker has written a heartbeat.
    """

    def __init__(self, wait_seconds: float) -> None:
        self._wait_seconds = wait_seconds
        self._since: dict[tuple[uuid.UUID, int, datetime | None], float] = {}
        self._orphaned_since: dict[uuid.UUID, float] = {}

    def confirm(self, stale: Sequence[Job]) -> list[Job]:
        """Return the stalled attempts that have not changed since they were first found, long enough ago."""
        now = time.monotonic()
        found = {(job.id, job.attempt, job.heartbeat_at): job for job in stale}
        # What was heard of again is forgotten, so that its time begins anew.
        self._since = {key: self._since.get(key, now) for key in found}
        return [job for key, job in found.items() if now - self._since[key] >= self._wait_seconds]

    def confirm_orphans(self, orphaned: Sequence[uuid.UUID]) -> list[uuid.UUID]:
        """Return the jobs that have been found without an entry each time, since long enough ago."""
        now = time.monotonic()
        self._orphaned_since = {job: self._orphaned_since.get(job, now) for job in orphaned}
        return [job for job, since in self._orphaned_since.items() if now - since >= self._wait_seconds]


async def recover_stalled_jobs(
    pool: Pool, job_queue: JobQueue, stale_seconds: float, stalled: StalledAttempts
) -> int:
    """Requeue jobs without a heartbeat for ``stale_seconds`` by the database's clock.

    Safe to run anywhere at any time; where another process is at it, nothing is done.

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
            if not await try_lock_recovery(connection):
                return 0
            await about_to_lock_jobs(connection)
            await cursor.execute(
                select_columns(
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
                # The owner reads it; a worker has the name of its host, which is for administrators.
                message = (
                    f"Its worker was not heard of for {stale_seconds:g} s: it was killed, froze or lost the "
                    "database."
                )
                await recover_attempt(connection, job_queue, job, {"type": "worker_lost", "message": message})
        # A transaction each, so that no job is locked while another is waited for.
        for job_id in stalled.confirm_orphans(await job_queue.orphaned_jobs(connection)):
            async with connection.transaction():
                again = await get_job(connection, job_id, lock=True)
                # If it got another entry meanwhile, requeue_job replaces that one.
                if again is not None and again.state == "queued":
                    logger.warning("job %s had no entry in the queue and got a new one", job_id)
                    await requeue_job(connection, job_queue, again)
        for root_id in await unsettled_roots(connection):
            await settle_root(connection, job_queue, root_id)
    return len(lost)
