"""The beginning of an attempt: a worker claims a queued job."""

import uuid

from octasplat.workers.db.connections import Pool
from octasplat.workers.db.events_and_logs import add_event, add_log_lines, trim_log
from octasplat.workers.queue.attempts import Attempt
from octasplat.workers.queue.jobs import get_job

MAX_EARLIER_LOG_LINES = 20_000
"""Lines of the attempts before that stay in the log when a new one begins."""


async def claim(pool: Pool, job_id: uuid.UUID, entry_id: int, worker: str) -> Attempt | None:
    """Begin an attempt at a queued job; None if the entry is stale because the job has continued."""
    async with pool.connection() as connection, connection.transaction():
        job = await get_job(connection, job_id, lock=True)
        if job is None or job.state != "queued" or job.slip != entry_id:
            return None
        # What goes on with what blocks have made stays as far as they are while photographs are fetched.
        await connection.execute(
            """
            UPDATE jobs SET state = 'running', attempt = attempt + 1, worker = %(worker)s, started_at = now(),
                heartbeat_at = now(),
                stage = CASE WHEN attempt + 1 = ANY(continuations) THEN stage END,
                step = CASE WHEN attempt + 1 = ANY(continuations) THEN step END,
                total_steps = CASE WHEN attempt + 1 = ANY(continuations) THEN total_steps END
            WHERE id = %(id)s
            """,
            {"worker": worker, "id": job_id},
        )
        # The order of turns in fair_share; not now(), which is the time at which the transaction began.
        await connection.execute(
            """
            INSERT INTO owner_turns (owner, queue) VALUES (%s, %s)
            ON CONFLICT (owner, queue) DO UPDATE SET turn_at = clock_timestamp()
            """,
            [job.owner, job.queue],
        )
        # ``job`` is the row as it was before the update.
        await add_event(connection, job_id, job.attempt + 1, "state", {"state": "running", "worker": worker})
        await trim_log(connection, job_id, MAX_EARLIER_LOG_LINES)
        number = job.attempt + 1
        line = (
            "Its blocks are trained" if number in job.continuations else f"Attempt {job.count_starts(number)}"
        )
        await add_log_lines(connection, job_id, number, [line])
        claimed = await get_job(connection, job_id)
    assert claimed is not None
    return Attempt(pool, claimed)
