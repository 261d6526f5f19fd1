"""Tasks on datasets: added within their owner's share, read, and waited for."""

import asyncio
import uuid
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Any

from octasplat.service.actions.access import fetch_visible_dataset
from octasplat.service.actions.pages import Page, page_of
from octasplat.service.auth import Principal
from octasplat.service.problems import ProblemError, not_found_error
from octasplat.service.settings import TaskShares
from octasplat.service.state import Service
from octasplat.workers.db import dataset_tasks as rows
from octasplat.workers.db.connections import Connection
from octasplat.workers.db.dataset_tasks import DatasetTask, TaskKind
from octasplat.workers.db.rows import Dataset

_FIRST_LOOK_SECONDS, _LAST_LOOK_SECONDS = 0.02, 0.5
_RETRY_SECONDS = 10
_NOUNS: Mapping[TaskKind, str] = {
    "commit": "commits of datasets",
    "import": "imports",
    "upload": "uploads",
}


async def _nothing(_connection: Connection) -> None:
    """Change nothing."""


@dataclass(frozen=True)
class TaskOutcome:
    """How a task ended.

    Attributes:
        result: what came of it.
        problem: why it failed; None if it did not.
        apply: makes its changes, in the transaction that ends it.
    """

    result: Mapping[str, Any] | None = None
    problem: ProblemError | None = None
    apply: Callable[[Connection], Awaitable[None]] = _nothing


async def check_share(connection: Connection, shares: TaskShares, owner: str, kind: TaskKind) -> None:
    """Refuse a further task where too many wait; for a transaction that has the lock of the owner.

    Raises:
        ProblemError: 429.
    """
    there = await rows.count_unfinished(connection, owner, kind)
    if there.of_all >= shares.max_unfinished or there.of_owner >= shares.max_unfinished_per_owner:
        detail = f"Too many {_NOUNS[kind]} wait; repeat the request in a moment."
        raise ProblemError(429, "busy", detail, retry_seconds=_RETRY_SECONDS)


async def new_task(
    service: Service,
    connection: Connection,
    dataset: Dataset,
    kind: TaskKind,
    request: Mapping[str, Any] | None = None,
) -> DatasetTask:
    """Add a task; it is taken at once where a place is free, as soon as the transaction has ended."""
    task = await rows.add_task(connection, dataset.id, dataset.owner, kind, request)
    # After a moment, as nobody sees the row before the caller's transaction ends.
    asyncio.get_running_loop().call_later(_FIRST_LOOK_SECONDS, service.task_added.set)
    return task


async def get_task(
    service: Service, principal: Principal, dataset_id: uuid.UUID, task_id: uuid.UUID
) -> DatasetTask:
    """Return a task on a dataset.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        await fetch_visible_dataset(connection, principal, dataset_id)
        task = await rows.get_task(connection, task_id)
    if task is None or task.dataset_id != dataset_id:
        raise not_found_error("task")
    return task


async def list_tasks(
    service: Service,
    principal: Principal,
    dataset_id: uuid.UUID,
    *,
    before: uuid.UUID | None = None,
    limit: int,
) -> Page[DatasetTask]:
    """Return the tasks on a dataset before ``before``, newest first.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        await fetch_visible_dataset(connection, principal, dataset_id)
        found = await rows.tasks_of(connection, dataset_id, before=before, limit=limit + 1)
    return page_of(found, limit, lambda task: task.id)


async def wait_for_task(service: Service, task: DatasetTask, seconds: float) -> DatasetTask:
    """Return a task when it is over, or as it is after so many seconds or when the service stops."""
    loop = asyncio.get_running_loop()
    deadline, pause = loop.time() + seconds, _FIRST_LOOK_SECONDS
    while not task.is_over and loop.time() < deadline and not service.event_broker.is_closing:
        await asyncio.sleep(min(pause, max(0.0, deadline - loop.time())))
        pause = min(1.5 * pause, _LAST_LOOK_SECONDS)
        async with service.pool.connection() as connection:
            found = await rows.get_task(connection, task.id)
        if found is None:
            raise not_found_error("task")
        task = found
    return task
