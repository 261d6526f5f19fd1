"""Datasets: made, listed, changed, checked, deleted; their files are in ``uploads``."""

import asyncio
import time
import uuid
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from typing import Any

import psycopg
from psycopg_pool import PoolTimeout

from octasplat.service.actions.access import owned_dataset
from octasplat.service.actions.parts import Part, cut
from octasplat.service.auth import Principal
from octasplat.service.idempotency import fingerprint, once
from octasplat.service.intake.dataset import DatasetFile as IntakeFile
from octasplat.service.intake.dataset import DatasetSummary, check_dataset
from octasplat.service.intake.inputs import check_inputs
from octasplat.service.schemas.datasets import DatasetChange, NewDataset
from octasplat.service.state import Service
from octasplat.service.threads import Threads, in_thread
from octasplat.workers.records import datasets as rows
from octasplat.workers.records.database import tried_again
from octasplat.workers.records.errors import Conflict
from octasplat.workers.records.quotas import check_new_dataset
from octasplat.workers.records.rows import Dataset, DatasetFile

END_CHECK_SECONDS = 60.0
"""For so long it is tried to say what a check found."""


@tried_again
async def create_dataset(
    service: Service, who: Principal, new: NewDataset, *, key: str | None = None
) -> Dataset:
    """Make a dataset; the same request with the same ``key`` makes nothing new.

    Raises:
        Problem: 422 if the key was used for another request.
        QuotaExceeded: the asker has too many.
    """
    async with service.pool.connection() as connection, connection.transaction():

        async def make() -> uuid.UUID:
            await check_new_dataset(connection, who.owner, service.settings.quota)
            return (await rows.create_dataset(connection, who.owner, new.name, new.holds)).id

        request = fingerprint("dataset", new.model_dump(exclude=set() if new.holds == "files" else {"holds"}))
        dataset_id, _ = await once(connection, who, key, request, make)
        return await owned_dataset(connection, who, dataset_id)


async def list_datasets(
    service: Service, who: Principal, *, before: uuid.UUID | None = None, limit: int
) -> Part[Dataset]:
    """Datasets that the asker may see, the newest first, those made before ``before``."""
    async with service.pool.connection() as connection:
        found = await rows.list_datasets(connection, owner=who.sees, before=before, limit=limit + 1)
    return cut(found, limit, lambda dataset: dataset.id)


async def list_files_named(
    service: Service, who: Principal, endings: Sequence[str], *, limit: int
) -> list[tuple[Dataset, str]]:
    """Files of the asker's committed datasets that hold files: those whose names end so, the newest first."""
    async with service.pool.connection() as connection:
        return await rows.files_named(connection, who.owner, endings, limit=limit)


async def get_dataset(service: Service, who: Principal, dataset_id: uuid.UUID) -> Dataset:
    """A dataset.

    Raises:
        Problem: 404.
    """
    async with service.pool.connection() as connection:
        return await owned_dataset(connection, who, dataset_id)


@tried_again
async def change_dataset(
    service: Service, who: Principal, dataset_id: uuid.UUID, change: DatasetChange
) -> Dataset:
    """Rename a dataset, or keep it whatever its age.

    Raises:
        Problem: 404.
    """
    async with service.pool.connection() as connection, connection.transaction():
        dataset = await owned_dataset(connection, who, dataset_id, lock=True)
        return await rows.change_dataset(
            connection,
            dataset_id,
            name=dataset.name if change.name is None else change.name,
            pinned=dataset.pinned if change.pinned is None else change.pinned,
        )


@tried_again
async def delete_dataset(service: Service, who: Principal, dataset_id: uuid.UUID) -> None:
    """Delete a dataset.

    Raises:
        Problem: 404.
        Conflict: a job needs it.
    """
    async with service.pool.connection() as connection:
        await owned_dataset(connection, who, dataset_id)
        await rows.delete_dataset(connection, dataset_id)
    service.room.after_deletion()


async def commit_dataset(service: Service, who: Principal, dataset_id: uuid.UUID) -> Dataset:
    """Check a dataset; one that is sound never changes again.

    Raises:
        Problem: 404; 429 with too many that wait to be checked.
        Conflict: it is being checked.
        IntakeRefused: it is not sound.
    """
    async with service.pool.connection() as connection:
        owner = (await owned_dataset(connection, who, dataset_id)).owner
    async with service.checks.passed(owner):
        return await _check(service, dataset_id)


async def _check(service: Service, dataset_id: uuid.UUID) -> Dataset:
    async with service.pool.connection() as connection:
        check = await rows.begin_check(connection, dataset_id)
        before = check.dataset
        if before.state == "committed":
            return before
        files = await rows.files_of(connection, dataset_id)
    summary: DatasetSummary | dict[str, Any] | None = None
    renewing = asyncio.create_task(_renew_check(service, check))
    try:
        known = [_for_intake(f) for f in files]
        if before.holds == "files":
            summary = check_inputs(known)
        else:
            limits = service.settings.dataset_limits()
            summary = await in_thread(Threads.CHECKS, check_dataset, service.storage, known, limits)
    finally:
        renewing.cancel()
        # Whatever happens, the dataset must not stay closed.
        dataset = await asyncio.shield(_end_check(service, check, summary))
    if dataset.state != "committed":
        raise Conflict("The dataset was opened while it was checked; commit it again.")
    return dataset


async def _renew_check(service: Service, check: rows.Check) -> None:
    """Say now and then that the check is under way; without that others take it for lost."""
    while True:
        await asyncio.sleep(rows.CHECK_LOST_SECONDS / 6)
        with suppress(psycopg.Error, PoolTimeout):
            async with service.pool.connection() as connection:
                await rows.renew_check(connection, check)


async def _end_check(
    service: Service, check: rows.Check, summary: DatasetSummary | dict[str, Any] | None
) -> Dataset:
    """Say what the check found, again and again while the database is away."""
    wait, deadline = 0.2, time.monotonic() + END_CHECK_SECONDS
    while True:
        try:
            return await _say_check(service, check, summary)
        except (psycopg.OperationalError, psycopg.InterfaceError, PoolTimeout):
            if time.monotonic() > deadline:
                raise  # whoever looks after lost checks opens it
        await asyncio.sleep(wait)
        wait = min(2 * wait, 5.0)


async def _say_check(
    service: Service, check: rows.Check, summary: DatasetSummary | dict[str, Any] | None
) -> Dataset:
    async with service.pool.connection() as connection:
        if summary is None:
            return await rows.end_check(connection, check, sound=False)
        if isinstance(summary, dict):
            return await rows.end_check(connection, check, sound=True, facts=summary)
        facts: dict[str, Any] = asdict(summary)
        photographs, has_poses = facts.pop("photographs"), facts.pop("has_model")
        return await rows.end_check(
            connection, check, sound=True, has_poses=has_poses, photographs=photographs, facts=facts
        )


def _for_intake(row: DatasetFile) -> IntakeFile:
    return IntakeFile(
        row.path,
        row.sha256,
        row.size_bytes,
        row.facts.get("width_px"),
        row.facts.get("height_px"),
        row.facts.get("warning"),
    )
