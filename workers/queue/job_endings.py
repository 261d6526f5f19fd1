"""How jobs end, and how those whose attempt was lost are given to another worker."""

from collections.abc import Mapping
from typing import Any

from octasplat.workers.db.connections import Connection
from octasplat.workers.db.events_and_logs import add_event, add_log_lines
from octasplat.workers.db.live_scenes import remove_live_scene
from octasplat.workers.db.postgres_text import as_json_or_null
from octasplat.workers.db.rows import TERMINAL, Job
from octasplat.workers.queue.jobs import requeue_job
from octasplat.workers.queue.protocol import JobQueue

MAX_RECOVERIES = 3
"""Lost attempts without a new checkpoint after which a job is taken for one that kills its workers."""
MAX_SILENT_RECOVERIES = 1
"""So many of them may be attempts that ended because they said nothing: each takes as long as that limit."""


async def end_job(connection: Connection, job: Job, state: str, error: Mapping[str, Any] | None) -> None:
    """Bring a job to a terminal state; the caller holds the job's lock."""
    await connection.execute(
        """
        UPDATE jobs SET state = %s, error = %s, finished_at = now(), slip = NULL, seconds_left = NULL,
            checkpoint = CASE WHEN %s THEN NULL ELSE checkpoint END
        WHERE id = %s
        """,
        [state, as_json_or_null(error), state == "succeeded", job.id],
    )
    if state == "succeeded" and job.root_id is None:  # a block is shown until the whole job has its results
        await remove_live_scene(connection, job.id)
    data: dict[str, Any] = {"state": state}
    if error is not None:
        data["error"] = dict(error)
    await add_event(connection, job.id, job.attempt, "state", data)
    line = {"succeeded": "Succeeded", "canceled": "Cancelled"}.get(state, "Failed")
    if error is not None:
        line += f": {error['message']}"
    await add_log_lines(connection, job.id, job.attempt, [line])


async def recover_attempt(
    connection: Connection,
    job_queue: JobQueue,
    job: Job,
    error: Mapping[str, Any],
    *,
    keep_entry: bool = False,
    delay_seconds: float = 0.0,
    max_recoveries: int = MAX_RECOVERIES,
) -> bool:
    """Give a job whose attempt was lost to another worker; the caller holds the job's lock.

    A job that was being cancelled is cancelled. One that was lost more than :data:`MAX_RECOVERIES` times, or
    more than ``max_recoveries`` times by this error, without advancing is failed with it. With ``keep_entry``
    the queue entry is still being delivered and is removed by that. The job is not taken up before
    ``delay_seconds`` have passed.

    Returns:
        Whether it failed.
    """
    if job.slip is not None and not keep_entry:
        await job_queue.remove(connection, job.slip)
    if job.state == "canceling":
        await end_job(connection, job, "canceled", None)
    elif job.rescues >= MAX_RECOVERIES or await _count_same_losses(connection, job, error) >= max_recoveries:
        message = f"{error['message']} This happened {job.rescues + 1} times without getting any further."
        await end_job(connection, job, "failed", {**error, "message": message, "rescues": job.rescues})
        return True
    else:
        await connection.execute("UPDATE jobs SET rescues = rescues + 1 WHERE id = %s", [job.id])
        data = {"reason": error["message"], "type": error.get("type"), "rescues": job.rescues + 1}
        await add_event(connection, job.id, job.attempt, "rescued", data)
        lost = f"Lost, and queued again: {error['message']}"
        await add_log_lines(connection, job.id, job.attempt, [lost])
        await requeue_job(
            connection,
            job_queue,
            job,
            keep_entry=keep_entry,
            delay_seconds=delay_seconds,
            reason=error["message"],
        )
    return False


async def _count_same_losses(connection: Connection, job: Job, error: Mapping[str, Any]) -> int:
    """Return how many attempts were lost by the same error since the job last advanced."""
    cursor = await connection.execute(
        """
        SELECT count(*) AS n FROM (
            SELECT data FROM job_events WHERE job_id = %s AND kind = 'rescued' ORDER BY id DESC LIMIT %s
        ) AS lost WHERE data->>'type' = %s
        """,
        # Progress sets ``rescues`` to 0, so that so many of the newest rows are those since then.
        [job.id, job.rescues, error.get("type")],
    )
    row = await cursor.fetchone()
    return int(row["n"]) if row else 0


async def count_requeues(connection: Connection, job: Job, reason: str) -> int:
    """Return how often a job was requeued for a reason since it last advanced or was accepted."""
    cursor = await connection.execute(
        """
        SELECT count(*) AS n FROM job_events
        WHERE job_id = %(job)s AND kind = 'handed_back' AND data->>'reason' = %(reason)s
          AND id > coalesce((
            SELECT max(id) FROM job_events WHERE job_id = %(job)s
              AND (kind = 'checkpoint' OR kind = 'state' AND data->>'state' = ANY(%(over)s))), 0)
        """,
        {"job": job.id, "reason": reason, "over": list(TERMINAL)},
    )
    row = await cursor.fetchone()
    return int(row["n"]) if row else 0
