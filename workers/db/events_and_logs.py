"""Append-only tables of job events and log lines."""

import uuid
from collections.abc import Mapping, Sequence
from typing import Any

from octasplat.workers.db.connections import Connection, fetch_all
from octasplat.workers.db.postgres_text import as_json, storable_text
from octasplat.workers.db.rows import JobEvent, LogLine

CHANNEL = "octasplat_events"
"""Notifications on this channel carry the id of the job that has a new event."""


async def add_event(
    connection: Connection, job_id: uuid.UUID, attempt: int, kind: str, data: Mapping[str, Any]
) -> None:
    """Add an event; listeners on :data:`CHANNEL` are notified when the transaction commits."""
    await add_events(connection, [job_id], attempt, kind, data)


async def add_events(
    connection: Connection, job_ids: Sequence[uuid.UUID], attempt: int, kind: str, data: Mapping[str, Any]
) -> None:
    """Add the same event to several jobs."""
    await connection.execute(
        "INSERT INTO job_events (job_id, attempt, kind, data) SELECT unnest(%s::uuid[]), %s, %s, %s",
        [list(job_ids), attempt, kind, as_json(dict(data))],
    )


async def add_log_lines(
    connection: Connection, job_id: uuid.UUID, attempt: int, lines: Sequence[str]
) -> None:
    """Add lines to the log of a job."""
    await connection.execute(
        """
        WITH counted AS MATERIALIZED (
            SELECT log_lines FROM octasplat_count_job_rows(%(job)s, 0, cardinality(%(lines)s::text[]))
        )
        INSERT INTO job_logs (job_id, attempt, text, number)
        SELECT %(job)s, %(attempt)s, line, log_lines - cardinality(%(lines)s::text[]) + place
        FROM counted, unnest(%(lines)s::text[]) WITH ORDINALITY AS given (line, place) ORDER BY place
        """,
        {"job": job_id, "attempt": attempt, "lines": [storable_text(line) for line in lines]},
    )


async def trim_log(connection: Connection, job_id: uuid.UUID, max_lines: int) -> None:
    """Delete all but the newest ``max_lines`` lines of a job's log."""
    await connection.execute(
        """
        DELETE FROM job_logs WHERE job_id = %(job)s AND id <= (
            SELECT id FROM job_logs WHERE job_id = %(job)s ORDER BY id DESC OFFSET %(keep)s LIMIT 1
        )
        """,
        {"job": job_id, "keep": max_lines},
    )


async def list_job_events(
    connection: Connection, job_id: uuid.UUID, after: int = 0, limit: int = 500
) -> list[JobEvent]:
    """Return the job's events whose number is above ``after``, in ascending order.

    All of them where the job never had an event of that number, as a client has it that was told the numbers
    of the former version.
    """
    return await fetch_all(
        connection,
        JobEvent,
        """
        SELECT {} FROM job_events WHERE job_id = %(job)s AND number > (
            SELECT CASE WHEN %(after)s > events THEN 0 ELSE %(after)s END
            FROM job_counts WHERE job_id = %(job)s
        ) ORDER BY number LIMIT %(limit)s
        """,
        {"job": job_id, "after": after, "limit": limit},
    )


async def list_log_lines(
    connection: Connection, job_id: uuid.UUID, after: int = 0, limit: int = 1000
) -> list[LogLine]:
    """Return the job's log lines whose number is above ``after``, as :func:`list_job_events` does."""
    return await fetch_all(
        connection,
        LogLine,
        """
        SELECT {} FROM job_logs WHERE job_id = %(job)s AND number > (
            SELECT CASE WHEN %(after)s > log_lines THEN 0 ELSE %(after)s END
            FROM job_counts WHERE job_id = %(job)s
        ) ORDER BY number LIMIT %(limit)s
        """,
        {"job": job_id, "after": after, "limit": limit},
    )
