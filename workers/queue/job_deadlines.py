"""Jobs that end before their work: run for too long, in a queue without workers, or on too small hosts."""

import uuid
from collections.abc import Mapping
from typing import Any

from psycopg.rows import class_row

from octasplat.workers.db.connections import Connection, Pool, select_columns
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.db.rows import TERMINAL, Job
from octasplat.workers.queue.job_endings import end_job
from octasplat.workers.queue.jobs import get_job
from octasplat.workers.queue.protocol import JobQueue
from octasplat.workers.queue.recovery import StalledAttempts


async def seconds_spent(connection: Connection, job: Job) -> float:
    """Return for how long workers had a job in earlier attempts, since it was accepted or retried."""
    cursor = await connection.execute(
        """
        SELECT coalesce(sum(extract(epoch FROM ended.at - began.at)), 0)::float8 AS seconds
        FROM job_events began CROSS JOIN LATERAL (
            SELECT min(at) AS at FROM job_events
            WHERE job_id = began.job_id AND id > began.id AND (kind = 'blocks_queued'
              OR kind = 'state' AND data->>'state' NOT IN ('running', 'canceling'))
        ) ended
        WHERE began.job_id = %s AND began.kind = 'state' AND began.data->>'state' = 'running'
          AND began.attempt < %s AND began.id > coalesce((
            SELECT max(id) FROM job_events
            WHERE job_id = began.job_id AND kind = 'state' AND data->>'state' = ANY(%s)), 0)
        """,
        [job.id, job.attempt, list(TERMINAL)],
    )
    row = await cursor.fetchone()
    return float(row["seconds"]) if row else 0.0


async def fail_abandoned_jobs(
    pool: Pool, job_queue: JobQueue, *, stale_seconds: float, hours: float, suspects: StalledAttempts
) -> list[uuid.UUID]:
    """Fail jobs that have waited for ``hours`` in a queue that no worker has taken for as long.

    Those of a paused queue wait for whoever has paused it, who may have ended the workers as well.

    Args:
        pool: connections.
        job_queue: the queue.
        stale_seconds: after how long a worker counts as gone.
        hours: how long they may wait; 0 lets them.
        suspects: those of the last time. Where all of the service was switched off, or slept, its workers
            come back a moment after whoever calls this.

    Returns:
        The jobs.
    """
    if hours <= 0:
        return []
    async with pool.connection() as connection, connection.cursor(row_factory=class_row(Job)) as cursor:
        await cursor.execute(
            select_columns(
                """
            SELECT {} FROM jobs WHERE state = 'queued'
              AND queued_at < now() - make_interval(secs => %(limit)s)
              AND NOT EXISTS (SELECT 1 FROM paused_queues WHERE paused_queues.queue = jobs.queue)
              AND NOT EXISTS (
                SELECT 1 FROM workers WHERE jobs.queue = ANY(workers.queues)
                  AND seen_at > now() - make_interval(secs => %(stale)s)
                  AND coalesce(facts->'kinds' ? jobs.kind, true))
              AND NOT EXISTS (
                SELECT 1 FROM jobs others WHERE others.queue = jobs.queue AND others.kind = jobs.kind
                  AND others.heartbeat_at > now() - make_interval(secs => %(limit)s))
            ORDER BY id LIMIT 1000
            """,
                Job,
            ),
            {"limit": 3600 * hours, "stale": stale_seconds},
        )
        found = suspects.confirm(await cursor.fetchall())
    ended = []
    for job in found:
        async with pool.connection() as connection, connection.transaction():
            # Nothing was locked when the jobs were found, and a worker may have taken one since.
            now = await get_job(connection, job.id, lock=True)
            if now is None or now.state != "queued" or now.slip != job.slip:
                continue
            if now.slip is not None:
                await job_queue.remove(connection, now.slip)
            message = (
                f"The job waited for {hours:g} hours in the queue {job.queue}, from which no worker takes "
                f"jobs of the kind {job.kind}; start "
                f"one with octasplat worker --queues {job.queue}, or ask for another queue."
            )
            await end_job(connection, now, "failed", {"type": "no_worker", "message": message})
            ended.append(job.id)
    return ended


async def fail_before_start(
    connection: Connection,
    job_id: uuid.UUID,
    entry_id: int,
    error: Mapping[str, Any],
    *,
    drop_checkpoint: bool = False,
) -> bool:
    """Fail a job whose entry is being delivered, before an attempt; False if it has continued meanwhile."""
    async with connection.transaction():
        # Without the row's lock, which comes after the owner's, see workers.db.locks.
        job = await get_job(connection, job_id)
        if job is not None and drop_checkpoint:
            await lock_owner(connection, job.owner)  # whose bytes get fewer
        job = await get_job(connection, job_id, lock=True)
        if job is None or job.state != "queued" or job.slip != entry_id:
            return False
        await end_job(connection, job, "failed", error)
        if drop_checkpoint:
            await connection.execute("UPDATE jobs SET checkpoint = NULL WHERE id = %s", [job_id])
    return True
