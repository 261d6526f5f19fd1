"""The part of the front end that works on tasks, its own and those of front ends that are gone."""

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress

import psycopg
from psycopg_pool import PoolTimeout

from octasplat.engine.core.errors import OctasplatError
from octasplat.service.actions.commits import run_commit
from octasplat.service.actions.dataset_tasks import TaskOutcome
from octasplat.service.actions.imports import run_import
from octasplat.service.actions.resumable_uploads import run_upload
from octasplat.service.problems import ProblemError, problem_from_error, unexpected_problem
from octasplat.service.settings import TaskShares
from octasplat.service.state import Service
from octasplat.workers.cancellation import cancel_and_wait
from octasplat.workers.db import dataset_tasks as rows
from octasplat.workers.db.dataset_tasks import DatasetTask, TaskKind

logger = logging.getLogger(__name__)

POLL_SECONDS = 1.0
"""How often it looks for tasks that other front ends have added."""
RENEW_SECONDS = 5.0
KEEP_ANNOUNCED_SECONDS = 15.0
MAX_END_SECONDS = 60.0
"""For so long it is tried to say how a task ended."""
_DATABASE_ERRORS = (psycopg.OperationalError, psycopg.InterfaceError, PoolTimeout)
_LOST = ProblemError(
    503, "task-lost", f"The service was lost {rows.MAX_ATTEMPTS} times while it worked on this; try again."
)
Work = Callable[[Service, DatasetTask], Awaitable[TaskOutcome]]


class TaskRunner:
    """Works on tasks, so many of a kind at once.

    Args:
        service: the service.
    """

    def __init__(self, service: Service) -> None:
        settings = service.settings
        self._service = service
        self._kinds: Mapping[TaskKind, tuple[Work, TaskShares]] = {
            "commit": (run_commit, settings.check_shares()),
            "import": (run_import, settings.import_shares()),
            "upload": (run_upload, settings.upload_shares()),
        }
        self._running: dict[asyncio.Task[None], DatasetTask] = {}
        self._renewed_at = self._announced_at = 0.0

    async def run(self) -> None:
        """Work until cancelled."""
        added = self._service.task_added
        while True:
            try:
                await self._look_after_tasks()
                await self._begin_tasks()
            except _DATABASE_ERRORS as error:
                logger.info("not looking for tasks for a moment: %s", error)
            except Exception:
                logger.exception("looking for tasks failed and is begun again")
            with suppress(TimeoutError):
                async with asyncio.timeout(POLL_SECONDS):
                    await added.wait()
            added.clear()

    async def close(self) -> None:
        """Hand the tasks back that are under way."""
        await cancel_and_wait(set(self._running))

    async def _begin_tasks(self) -> None:
        for kind, (work, shares) in self._kinds.items():
            while (count := self._count_running(kind)) < shares.max_running:
                async with self._service.pool.connection() as connection:
                    if self._service.is_draining:  # meanwhile
                        return
                    task = await rows.claim_task(connection, kind, max_per_owner=shares.per_owner(count))
                if task is None:
                    break
                running = asyncio.create_task(self._work(work, task))
                self._running[running] = task
                running.add_done_callback(self._forget)

    def _count_running(self, kind: str) -> int:
        return sum(task.kind == kind for task in self._running.values())

    def _forget(self, running: asyncio.Task[None]) -> None:
        del self._running[running]
        self._service.task_added.set()  # its place is free
        if not running.cancelled() and (error := running.exception()) is not None:
            logger.error("a task on a dataset was not ended", exc_info=error)

    async def _look_after_tasks(self) -> None:
        now = time.monotonic()
        if now - self._renewed_at < RENEW_SECONDS:
            return
        async with self._service.pool.connection() as connection:
            ours = await rows.renew_tasks(connection, list(self._running.values()))
            for task in await rows.requeue_lost_tasks(connection, _LOST.document()):
                logger.warning("the %s %s of a lost process is %s", task.kind, task.id, task.state)
            if now - self._announced_at >= KEEP_ANNOUNCED_SECONDS:
                await rows.keep_announced_checks(connection)
                self._announced_at = now
        self._renewed_at = now
        for running, task in list(self._running.items()):
            if task.id not in ours:
                running.cancel()  # its dataset was deleted, or another process has taken it

    async def _work(self, work: Work, task: DatasetTask) -> None:
        try:
            outcome = await _outcome(work, self._service, task)
            await asyncio.shield(self._end(task, outcome))
        except (asyncio.CancelledError, *_DATABASE_ERRORS):
            with suppress(*_DATABASE_ERRORS):
                async with self._service.pool.connection() as connection:
                    await rows.hand_back_task(connection, task)
            raise

    async def _end(self, task: DatasetTask, outcome: TaskOutcome) -> None:
        """Record how a task ended, with retries while the database is away."""
        wait, deadline = 0.2, time.monotonic() + MAX_END_SECONDS
        while True:
            try:
                await self._record(task, outcome)
                return
            except OctasplatError as error:
                # The changes of the outcome are refused, and that is how the task ends.
                outcome = TaskOutcome(problem=problem_from_error(error))
                continue
            except _DATABASE_ERRORS:
                if time.monotonic() > deadline:
                    raise  # whoever looks after lost tasks takes it up
            await asyncio.sleep(wait)
            wait = min(2 * wait, 5.0)

    async def _record(self, task: DatasetTask, outcome: TaskOutcome) -> None:
        problem = None if outcome.problem is None else outcome.problem.document()
        async with self._service.pool.connection() as connection, connection.transaction():
            await outcome.apply(connection)
            if not await rows.end_task(connection, task, result=outcome.result, problem=problem):
                # Another process has the task, and nothing of what was applied may stay.
                raise psycopg.Rollback


async def _outcome(work: Work, service: Service, task: DatasetTask) -> TaskOutcome:
    """Do the work of a task; an error is its outcome, unless the database is away."""
    try:
        return await work(service, task)
    except ProblemError as error:
        return TaskOutcome(problem=error)
    except OctasplatError as error:
        return TaskOutcome(problem=problem_from_error(error))
    except _DATABASE_ERRORS:
        raise
    except Exception:
        logger.exception("the %s %s failed", task.kind, task.id)
        return TaskOutcome(problem=unexpected_problem())
