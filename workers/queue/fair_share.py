"""Fair share between owners: a queue entry says that some job may begin, not which one.

The owner who holds the fewest workers goes first, and among these the one whose turn was longest ago. Jobs of
one owner go by priority, and where it is the same in their order; the blocks of a job go where it does, the
longest first. An owner to whom an administrator gave a share other than 1 counts as if so many owners had its
jobs. A job that waits for its blocks holds no worker, and each of these that is under way one.

A choice takes a look at the index for each owner that waits, however many jobs they have queued.
"""

import uuid
from typing import LiteralString

from psycopg.rows import class_row

from octasplat.workers.db.connections import Connection, Pool, select_columns
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.jobs import get_job, requeue_job
from octasplat.workers.queue.protocol import JobQueue

_MAX_CANDIDATES = 30
_MAX_JOBS_PER_OWNER = 4
"""Further jobs of an owner are tried where other workers are just taking the first."""
# The owners of a queue's waiting jobs, and NULL: a loose index scan, one look-up an owner; DISTINCT would
# read every queued job.
_OWNERS_THAT_WAIT: LiteralString = """
    WITH RECURSIVE owners_that_wait AS (
        (SELECT owner FROM jobs WHERE state = 'queued' AND queue = %(queue)s ORDER BY owner LIMIT 1)
        UNION ALL
        SELECT (
            SELECT jobs.owner FROM jobs
            WHERE state = 'queued' AND queue = %(queue)s AND jobs.owner > owners_that_wait.owner
            ORDER BY jobs.owner LIMIT 1
        ) FROM owners_that_wait WHERE owners_that_wait.owner IS NOT NULL
    )
    """
_FAIR_ORDER: LiteralString = (
    _OWNERS_THAT_WAIT  # noqa: S608 - constants
    + """
    , busy AS (
        SELECT owner, count(*) AS n FROM jobs
        WHERE state IN ('running', 'canceling') AND queue = %(queue)s AND heartbeat_at IS NOT NULL
        GROUP BY owner
    )
    SELECT candidates.id FROM owners_that_wait AS owners
    CROSS JOIN LATERAL (
        SELECT id, priority, coalesce(place, slip) AS place, slip FROM jobs
        WHERE state = 'queued' AND queue = %(queue)s AND owner = owners.owner
          AND (delayed_until IS NULL OR delayed_until <= now())
        ORDER BY priority DESC, coalesce(place, slip), slip LIMIT %(jobs)s
    ) AS candidates
    LEFT JOIN busy USING (owner)
    LEFT JOIN owner_turns turns ON turns.owner = owners.owner AND turns.queue = %(queue)s
    LEFT JOIN quotas ON quotas.owner = owners.owner
    ORDER BY coalesce(busy.n, 0) / coalesce(quotas.share, 1),
        extract(epoch FROM statement_timestamp() - turns.turn_at) * coalesce(quotas.share, 1)
            DESC NULLS FIRST,
        owners.owner, candidates.priority DESC, candidates.place, candidates.slip
    LIMIT %(tried)s
    """
)
# Owners take turns: of each other one as many go before as of this one, one more if it waits longer.
_JOBS_AHEAD: LiteralString = (
    _OWNERS_THAT_WAIT  # noqa: S608 - constants
    + """
    , own AS (
        SELECT count(DISTINCT coalesce(place, slip)) AS n FROM jobs
        WHERE state = 'queued' AND queue = %(queue)s AND owner = %(owner)s
          AND (priority > %(priority)s OR priority = %(priority)s AND coalesce(place, slip) < %(place)s)
    )
    SELECT own.n + coalesce(sum(least(others.n, own.n + (others.next < %(place)s)::int)), 0) AS ahead
    FROM own LEFT JOIN LATERAL (
        SELECT waiting.n, waiting.next FROM owners_that_wait CROSS JOIN LATERAL (
            SELECT count(*) AS n, (array_agg(place ORDER BY priority DESC, place))[1] AS next FROM (
                SELECT DISTINCT priority, coalesce(place, slip) AS place FROM jobs
                WHERE state = 'queued' AND queue = %(queue)s AND owner = owners_that_wait.owner
                ORDER BY priority DESC, place LIMIT own.n + 1
            ) AS first
        ) AS waiting WHERE owners_that_wait.owner <> %(owner)s
    ) AS others ON true
    GROUP BY own.n
    """
)


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
        # The delivered entry is used up whichever job begins, so that its own job needs another.
        await requeue_job(
            connection, job_queue, job, keep_entry=True, without_event=True, reason=job.waits_for
        )
        return chosen.id, chosen.slip


async def queue_position(connection: Connection, job: Job) -> int | None:
    """Return how many jobs go before a queued job in its queue, if owners take turns; None for any other.

    A job of which blocks wait is one. Of another owner no more are looked at than go before it.
    """
    if job.state != "queued":
        return None
    cursor = await connection.execute(
        _JOBS_AHEAD,
        {
            "queue": job.queue,
            "owner": job.owner,
            "priority": job.priority,
            "place": job.place_in_queue,
        },
    )
    row = await cursor.fetchone()
    return int(row["ahead"]) if row else 0


async def _next_fair_job(connection: Connection, job_queue: JobQueue, job: Job) -> Job | None:
    """Return the job that goes before ``job``, its entry taken out of the queue; None if there is none."""
    cursor = await connection.execute(
        _FAIR_ORDER,
        {"queue": job.queue, "jobs": _MAX_JOBS_PER_OWNER, "tried": _MAX_CANDIDATES},
    )
    for row in await cursor.fetchall():
        if row["id"] == job.id:
            return None
        async with connection.cursor(row_factory=class_row(Job)) as locking:
            # Another worker may be taking the row right now, and waiting for it would take longer than the
            # next one.
            query = "SELECT {} FROM jobs WHERE id = %s AND state = 'queued' FOR UPDATE SKIP LOCKED"
            await locking.execute(select_columns(query, Job), [row["id"]])
            other = await locking.fetchone()
        # An entry that is being delivered is left to the worker that has it.
        if (
            other is not None
            and other.slip is not None
            and await job_queue.take_waiting(connection, other.slip)
        ):
            return other
    return None
