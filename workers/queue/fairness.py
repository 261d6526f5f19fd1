"""Owners take turns: a slip says that a job may begin, not whose it is.

Of jobs of the same priority goes first that of an owner with the fewest that run, and among these of the one
whose turn was longest ago. Jobs of one owner keep their order.
"""

import uuid

from psycopg.rows import class_row

from octasplat.workers.queue.jobs import get_job, queue_again
from octasplat.workers.queue.port import Slips
from octasplat.workers.records.database import Connection, Pool, naming
from octasplat.workers.records.rows import Job

_TRIED = 30


async def choose(pool: Pool, slips: Slips, job_id: uuid.UUID, slip: int) -> tuple[uuid.UUID, int] | None:
    """Which job to begin when a slip is delivered, and its slip; None if the slip is stale.

    If that is another job than the slip's, the latter goes back to its place.
    """
    async with pool.connection() as connection, connection.transaction():
        job = await get_job(connection, job_id, lock=True)
        if job is None or job.state != "queued" or job.slip != slip:
            return None
        chosen = await _fairest(connection, slips, job)
        if chosen is None or chosen.slip is None:
            return job_id, slip
        await queue_again(connection, slips, job, keep_slip=True, quiet=True)
        return chosen.id, chosen.slip


async def _fairest(connection: Connection, slips: Slips, job: Job) -> Job | None:
    """The job that goes before ``job``, its slip taken out of the queue; None if none does."""
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
        {"queue": job.queue, "priority": job.priority, "tried": _TRIED},
    )
    for row in await cursor.fetchall():
        if row["id"] == job.id:
            return None
        async with connection.cursor(row_factory=class_row(Job)) as locking:
            query = "SELECT {} FROM jobs WHERE id = %s AND state = 'queued' FOR UPDATE SKIP LOCKED"
            await locking.execute(naming(query, Job), [row["id"]])
            other = await locking.fetchone()
        if other is not None and other.slip is not None and await slips.take(connection, other.slip):
            return other
    return None
