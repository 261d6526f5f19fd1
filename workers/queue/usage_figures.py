"""Counts of jobs that wait and run, and how long workers took, of an owner or of all."""

from octasplat.workers.db.connections import Connection
from octasplat.workers.queue.protocol import QueueDepth


async def queue_depths(connection: Connection, owner: str | None = None) -> list[QueueDepth]:
    """Return the count of an owner's waiting jobs in each queue that has some.

    None counts all owners', for those who look after workers: blocks by themselves, as each takes a worker.
    """
    cursor = await connection.execute(
        """
        SELECT queue, count(*) AS waiting,
            extract(epoch FROM now() - min(queued_at))::float8 AS oldest_seconds
        FROM jobs WHERE state = 'queued'
          AND (%(owner)s::text IS NULL OR owner = %(owner)s AND root_id IS NULL)
        GROUP BY queue ORDER BY queue
        """,
        {"owner": owner},
    )
    return [QueueDepth(**row) for row in await cursor.fetchall()]


async def running_by_queue(connection: Connection, owner: str | None = None) -> dict[str, int]:
    """Return the number of an owner's running jobs by queue; None counts what all owners' workers do."""
    cursor = await connection.execute(
        """
        SELECT queue, count(*) AS n FROM jobs WHERE state IN ('running', 'canceling')
          AND (%(owner)s::text IS NULL AND heartbeat_at IS NOT NULL OR owner = %(owner)s AND root_id IS NULL)
        GROUP BY queue
        """,
        {"owner": owner},
    )
    return {row["queue"]: row["n"] for row in await cursor.fetchall()}


async def running_by_worker(connection: Connection) -> dict[str, int]:
    """Return the number of running jobs by the name of their worker."""
    cursor = await connection.execute(
        """
        SELECT worker, count(*) AS n FROM jobs
        WHERE state IN ('running', 'canceling') AND worker IS NOT NULL GROUP BY worker
        """
    )
    return {row["worker"]: row["n"] for row in await cursor.fetchall()}


async def worked_seconds(connection: Connection, owner: str) -> float:
    """Return how long workers took for an owner's jobs, by the newest attempt of each.

    No worker has a job while it waits for its blocks, nor if it ends then: these are jobs by themselves.
    """
    cursor = await connection.execute(
        """
        SELECT coalesce(sum(extract(epoch FROM CASE WHEN heartbeat_at IS NOT NULL
            THEN coalesce(finished_at, now())
            ELSE (SELECT max(at) FROM job_events WHERE job_id = jobs.id AND kind = 'blocks_queued')
            END - started_at)), 0)::float8 AS seconds
        FROM jobs WHERE owner = %s AND started_at IS NOT NULL AND state <> 'queued'
        """,
        [owner],
    )
    row = await cursor.fetchone()
    return max(0.0, float(row["seconds"])) if row is not None else 0.0
