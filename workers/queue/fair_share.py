"""Fair share between owners: a queue entry says that some job may begin, not which one.

Among jobs of the same priority, that of an owner with the fewest running jobs goes first, and among these
that of the owner whose turn was longest ago. Jobs of one owner keep their order.
"""

import uuid

from psycopg.rows import class_row

from octasplat.workers.db.connections import Connection, Pool, select_columns
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.jobs import get_job, requeue_job
from octasplat.workers.queue.protocol import JobQueue

_MAX_CANDIDATES = 30


async def choose_job(
    pool: Pool, job_queue: JobQueue, job_id: uuid.UUID, entry_id: int
) -> tuple[uuid.UUID, int] | None:
    """Return the job to begin when an entry is delivered, and its entry; None if the entry is stale.

    If that is another job than the entry's, the latter is queued again at its place.
    """
    async with pool.connection() as connection, connection.transaction():
        job = await get_job(connection, job_id, lock=True)
        if job is None or job.state != "queued" or job.slip != entry_id:
            return None
        chosen = await _next_fair_job(connection, job_queue, job)
        if chosen is None or chosen.slip is None:
            return job_id, entry_id
        await requeue_job(connection, job_queue, job, keep_entry=True, without_event=True)
        return chosen.id, chosen.slip


async def _next_fair_job(connection: Connection, job_queue: JobQueue, job: Job) -> Job | None:
    """Return the job that goes before ``job``, its entry taken out of the queue; None if there is none."""
    cursor = await connection.execute(
        """
        SELECT jobs.id FROM jobs
        LEFT JOIN (
            SELECT owner, count(*) AS n FROM jobs
            WHERE state IN ('running', 'canceling') AND queue = %(queue)s GROUP BY owner
        ) AS busy USING (owner)
        LEFT JOIN owner_turns turns ON turns.owner = jobs.owner AND turns.queue = jobs.queue
        WHERE jobs.state = 'queued' AND jobs.queue = %(queue)s AND jobs.priority = %(priority)s
        ORDER BY coalesce(busy.n, 0), turns.turn_at NULLS FIRST, jobs.slip LIMIT %(tried)s
        """,
        {"queue": job.queue, "priority": job.priority, "tried": _MAX_CANDIDATES},
    )
    for row in await cursor.fetchall():
        if row["id"] == job.id:
            return None
        async with connection.cursor(row_factory=class_row(Job)) as locking:
            query = "SELECT {} FROM jobs WHERE id = %s AND state = 'queued' FOR UPDATE SKIP LOCKED"
            await locking.execute(select_columns(query, Job), [row["id"]])
            other = await locking.fetchone()
        if (
            other is not None
            and other.slip is not None
            and await job_queue.take_waiting(connection, other.slip)
        ):
            return other
    return None
