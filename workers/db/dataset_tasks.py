"""Tasks on datasets that last longer than a request, such as commits, in the table that hands them out.

A front end claims a task, says every few seconds that it still works on it, and ends it. A task of which
nothing was heard for a while is handed out again; each write carries the attempt that it belongs to.
"""

import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from octasplat.workers.db.connections import Connection, fetch_all, fetch_one
from octasplat.workers.db.ids import new_id
from octasplat.workers.db.locks import lock_tasks
from octasplat.workers.db.postgres_text import as_json

TaskKind = Literal["commit", "import", "upload"]
TaskState = Literal["queued", "running", "succeeded", "failed"]
LOST_SECONDS = 30
"""A task of which nothing was heard for so long is handed out again; its process is gone."""
MAX_ATTEMPTS = 3
"""A task whose process is lost so often is given up."""
ANNOUNCED_SECONDS = 10
"""For so long a check counts as announced just now."""
KEPT_DAYS = 7
"""For so long the outcome of a task can be asked for."""


@dataclass(frozen=True)
class DatasetTask:
    """A task on a dataset.

    Attributes:
        id: UUIDv7.
        dataset_id: what it works on.
        owner: of the dataset, whose share of the places it takes.
        kind: what is done.
        state: ``queued``, ``running``, ``succeeded`` or ``failed``.
        request: what was asked for; empty once it is over, as addresses may hold secrets.
        attempt: counts starts.
        result: what came of it.
        problem: why it failed: ``status``, ``code``, ``detail`` and perhaps ``errors``.
        created_at: when it was asked for.
        started_at: when its current attempt began.
        finished_at: when it came to its end.
    """

    id: uuid.UUID
    dataset_id: uuid.UUID
    owner: str
    kind: TaskKind
    state: TaskState
    request: dict[str, Any]
    attempt: int
    result: dict[str, Any] | None
    problem: dict[str, Any] | None
    created_at: datetime
    started_at: datetime | None
    finished_at: datetime | None

    @property
    def is_over(self) -> bool:
        """Return whether the task has come to its end."""
        return self.state in ("succeeded", "failed")


@dataclass(frozen=True)
class TaskCounts:
    """Unfinished tasks of some kinds: of an owner, and of all."""

    of_owner: int
    of_all: int


async def add_task(
    connection: Connection,
    dataset_id: uuid.UUID,
    owner: str,
    kind: TaskKind,
    request: Mapping[str, Any] | None = None,
) -> DatasetTask:
    """Add a task that waits to be claimed."""
    query = """
        INSERT INTO dataset_tasks (id, dataset_id, owner, kind, request)
        VALUES (%s, %s, %s, %s, %s) RETURNING {}
        """
    values = [new_id(), dataset_id, owner, kind, as_json(dict(request or {}))]
    task = await fetch_one(connection, DatasetTask, query, values)
    assert task is not None
    return task


async def get_task(connection: Connection, task_id: uuid.UUID) -> DatasetTask | None:
    """Return the task of that id, or None."""
    return await fetch_one(connection, DatasetTask, "SELECT {} FROM dataset_tasks WHERE id = %s", [task_id])


async def tasks_of(
    connection: Connection,
    dataset_id: uuid.UUID,
    *,
    kind: TaskKind | None = None,
    unfinished: bool = False,
    before: uuid.UUID | None = None,
    limit: int = 50,
) -> list[DatasetTask]:
    """Return tasks on a dataset, newest first, or only those of a ``kind`` or that are ``unfinished``."""
    return await fetch_all(
        connection,
        DatasetTask,
        """
        SELECT {} FROM dataset_tasks WHERE dataset_id = %(dataset)s
          AND (%(kind)s::text IS NULL OR kind = %(kind)s)
          AND (NOT %(unfinished)s OR state IN ('queued', 'running'))
          AND (%(before)s::uuid IS NULL OR id < %(before)s)
        ORDER BY id DESC LIMIT %(limit)s
        """,
        {"dataset": dataset_id, "kind": kind, "unfinished": unfinished, "before": before, "limit": limit},
    )


async def count_unfinished(connection: Connection, owner: str, kind: TaskKind) -> TaskCounts:
    """Return how many tasks of a kind wait or are worked on."""
    cursor = await connection.execute(
        """
        SELECT count(*) FILTER (WHERE owner = %s) AS of_owner, count(*) AS of_all FROM dataset_tasks
        WHERE state IN ('queued', 'running') AND kind = %s
        """,
        [owner, kind],
    )
    row = await cursor.fetchone()
    assert row is not None
    return TaskCounts(row["of_owner"], row["of_all"])


async def claim_task(connection: Connection, kind: TaskKind, *, max_per_owner: int) -> DatasetTask | None:
    """Claim a task that waits; None where none may be begun.

    The owner of whom the fewest are being worked on, and who had a turn least recently, is next, so that many
    of one owner keep nobody else waiting for longer than one of them takes.

    Args:
        connection: to the database.
        kind: of task.
        max_per_owner: how many of one owner are worked on at once.
    """
    async with connection.transaction():
        # Front ends that ask at once would each count without what the other one claims.
        await lock_tasks(connection, kind)
        return await fetch_one(
            connection,
            DatasetTask,
            """
            UPDATE dataset_tasks SET state = 'running', attempt = attempt + 1, started_at = clock_timestamp(),
                seen_at = clock_timestamp()
            WHERE id = (
                SELECT task.id FROM dataset_tasks task CROSS JOIN LATERAL (
                    SELECT count(*) FILTER (WHERE state = 'running') AS running, max(started_at) AS turn_at
                    FROM dataset_tasks WHERE owner = task.owner AND kind = task.kind
                ) turn
                WHERE task.state = 'queued' AND task.kind = %(kind)s AND turn.running < %(most)s
                ORDER BY turn.running, turn.turn_at NULLS FIRST, task.id LIMIT 1
                FOR UPDATE OF task SKIP LOCKED
            )
            RETURNING {}
            """,
            {"kind": kind, "most": max_per_owner},
        )


async def renew_tasks(connection: Connection, tasks: Sequence[DatasetTask]) -> set[uuid.UUID]:
    """Say that these are still worked on; returns the ids of those that are still this process's."""
    cursor = await connection.execute(
        """
        UPDATE dataset_tasks SET seen_at = clock_timestamp()
        FROM unnest(%s::uuid[], %s::integer[]) AS mine (id, attempt)
        WHERE dataset_tasks.id = mine.id AND dataset_tasks.attempt = mine.attempt AND state = 'running'
        RETURNING dataset_tasks.id
        """,
        [[task.id for task in tasks], [task.attempt for task in tasks]],
    )
    return {row["id"] for row in await cursor.fetchall()}


async def end_task(
    connection: Connection,
    task: DatasetTask,
    *,
    result: Mapping[str, Any] | None = None,
    problem: Mapping[str, Any] | None = None,
) -> bool:
    """End a task, with a problem as failed; False if it is not this attempt's any more."""
    cursor = await connection.execute(
        """
        UPDATE dataset_tasks SET state = %(state)s, result = %(result)s, problem = %(problem)s,
            request = '{}', finished_at = clock_timestamp()
        WHERE id = %(id)s AND attempt = %(attempt)s AND state = 'running'
        """,
        {
            "state": "succeeded" if problem is None else "failed",
            "result": None if result is None else as_json(dict(result)),
            "problem": None if problem is None else as_json(dict(problem)),
            "id": task.id,
            "attempt": task.attempt,
        },
    )
    return cursor.rowcount > 0


async def hand_back_task(connection: Connection, task: DatasetTask) -> None:
    """Queue a task again that this process does not finish; the attempt does not count."""
    await connection.execute(
        """
        UPDATE dataset_tasks SET state = 'queued', attempt = attempt - 1
        WHERE id = %s AND attempt = %s AND state = 'running'
        """,
        [task.id, task.attempt],
    )


async def requeue_lost_tasks(connection: Connection, problem: Mapping[str, Any]) -> list[DatasetTask]:
    """Queue tasks again whose process was lost; those that were lost too often fail with ``problem``."""
    return await fetch_all(
        connection,
        DatasetTask,
        """
        UPDATE dataset_tasks SET state = CASE WHEN attempt < %(most)s THEN 'queued' ELSE 'failed' END,
            problem = CASE WHEN attempt < %(most)s THEN NULL ELSE %(problem)s END,
            request = CASE WHEN attempt < %(most)s THEN request ELSE jsonb_build_object() END,
            finished_at = CASE WHEN attempt < %(most)s THEN NULL ELSE clock_timestamp() END
        WHERE id IN (
            SELECT id FROM dataset_tasks
            WHERE state = 'running' AND seen_at < clock_timestamp() - make_interval(secs => %(lost)s)
            FOR UPDATE SKIP LOCKED
        )
        RETURNING {}
        """,
        {"most": MAX_ATTEMPTS, "problem": as_json(dict(problem)), "lost": LOST_SECONDS},
    )


async def keep_announced_checks(connection: Connection) -> None:
    """Say that datasets whose commits wait are still to be checked.

    Processes of the former version, which know nothing of tasks, would open them otherwise. What was said a
    moment ago stays: a task may have been claimed since this statement began, and its check is told by that.
    """
    await connection.execute(
        """
        UPDATE datasets SET used_at = clock_timestamp()
        WHERE state = 'checking' AND used_at < clock_timestamp() - make_interval(secs => %s) AND id IN (
            SELECT dataset_id FROM dataset_tasks WHERE kind = 'commit' AND state = 'queued'
        )
        """,
        [ANNOUNCED_SECONDS],
    )


async def delete_old_tasks(connection: Connection) -> None:
    """Delete tasks that have been over for long."""
    await connection.execute(
        """
        DELETE FROM dataset_tasks WHERE state IN ('succeeded', 'failed')
          AND finished_at < now() - make_interval(days => %s)
        """,
        [KEPT_DAYS],
    )
