"""Commits of datasets: tasks that validate the files and close the dataset for good."""

import asyncio
import logging
import uuid
from contextlib import suppress
from dataclasses import asdict
from typing import Any

import psycopg
from psycopg_pool import PoolTimeout

from octasplat.engine.core.errors import OctasplatError
from octasplat.service.actions.access import check_not_draining, fetch_visible_dataset
from octasplat.service.actions.dataset_tasks import TaskOutcome, check_share, new_task
from octasplat.service.auth import Principal
from octasplat.service.intake.dataset import DatasetFile as IntakeFile
from octasplat.service.intake.dataset import DatasetSummary, check_dataset
from octasplat.service.intake.input_files import check_input_files
from octasplat.service.problems import problem_from_error, unexpected_problem
from octasplat.service.state import Service
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.workers.db import dataset_checks as checks
from octasplat.workers.db import datasets as rows
from octasplat.workers.db.connections import Connection, retry_on_deadlock
from octasplat.workers.db.dataset_tasks import DatasetTask, tasks_of
from octasplat.workers.db.errors import ConflictError
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.db.rows import Dataset, DatasetFile

logger = logging.getLogger(__name__)


@retry_on_deadlock
async def request_commit(service: Service, principal: Principal, dataset_id: uuid.UUID) -> DatasetTask | None:
    """Return the task that commits a dataset, a new one unless there is one; None if it is committed.

    The dataset takes no files from then on; it is open again if the task fails.

    Raises:
        ProblemError: 404; 429 with too many that wait.
        ConflictError: files of it are being fetched.
    """
    check_not_draining(service)
    async with service.pool.connection() as connection, connection.transaction():
        owner = (await fetch_visible_dataset(connection, principal, dataset_id)).owner
        # The owner's lock comes before the row's, see workers.db.locks.
        await lock_owner(connection, owner)
        dataset = await fetch_visible_dataset(connection, principal, dataset_id, lock=True)
        if dataset.state == "committed":
            return None
        unfinished = await tasks_of(connection, dataset_id, unfinished=True)
        for task in unfinished:
            if task.kind == "commit":
                return task
        if unfinished:
            raise ConflictError(
                f"{len(unfinished)} imports or uploads into the dataset are under way; commit it when they "
                "are over."
            )
        await check_share(connection, service.settings.check_shares(), owner, "commit")
        await checks.announce_check(connection, dataset)
        return await new_task(service, connection, dataset, "commit")


async def run_commit(service: Service, task: DatasetTask) -> TaskOutcome:
    """Validate a dataset; the outcome commits it, or opens it again with what is wrong."""
    async with service.pool.connection() as connection:
        check = await checks.begin_check(connection, task.dataset_id)
        if check.dataset.state == "committed":
            return TaskOutcome()
        files = await rows.files_of(connection, task.dataset_id)
    renewing = asyncio.create_task(_renew_check(service, check))
    try:
        summary = await _validate(service, check.dataset, files)
    except Exception as error:  # whatever happens, the dataset must not stay closed
        if isinstance(error, OctasplatError):
            problem = problem_from_error(error)
        else:
            logger.exception("the commit %s failed", task.id)
            problem = unexpected_problem()
        return TaskOutcome(problem=problem, apply=lambda connection: _reopen(connection, check))
    finally:
        renewing.cancel()
    return TaskOutcome(apply=lambda connection: _commit(connection, check, summary))


async def _validate(
    service: Service, dataset: Dataset, files: list[DatasetFile]
) -> DatasetSummary | dict[str, Any]:
    known = [_intake_file(file) for file in files]
    if dataset.holds == "files":
        return check_input_files(known)
    limits = service.settings.dataset_limits()
    return await run_in_pool(ThreadPurpose.CHECKS, check_dataset, service.storage, known, limits)


async def _renew_check(service: Service, check: checks.Check) -> None:
    """Renew the validation regularly; without that it counts as abandoned."""
    while True:
        # Several tries may fail before the validation counts as abandoned.
        await asyncio.sleep(rows.STALE_CHECK_SECONDS / 6)
        with suppress(psycopg.Error, PoolTimeout):
            async with service.pool.connection() as connection:
                await checks.renew_check(connection, check)


async def _reopen(connection: Connection, check: checks.Check) -> None:
    await checks.end_check(connection, check, is_valid=False)


async def _commit(
    connection: Connection, check: checks.Check, summary: DatasetSummary | dict[str, Any]
) -> None:
    """Record a dataset as valid.

    Raises:
        ConflictError: it was opened meanwhile, as by a process that took this one for lost.
    """
    if isinstance(summary, dict):
        dataset = await checks.end_check(connection, check, is_valid=True, facts=summary)
    else:
        facts: dict[str, Any] = asdict(summary)
        photographs, has_poses = facts.pop("photographs"), facts.pop("has_model")
        dataset = await checks.end_check(
            connection, check, is_valid=True, has_poses=has_poses, photographs=photographs, facts=facts
        )
    if dataset.state != "committed":
        raise ConflictError("The dataset was opened while it was checked; commit it again.")


def _intake_file(row: DatasetFile) -> IntakeFile:
    return IntakeFile(
        row.path,
        row.sha256,
        row.size_bytes,
        row.facts.get("width_px"),
        row.facts.get("height_px"),
        row.facts.get("warning"),
    )
