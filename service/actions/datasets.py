"""Datasets: created, listed, changed, validated, deleted; their files are in ``uploads``."""

import asyncio
import time
import uuid
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict
from typing import Any

import psycopg
from psycopg_pool import PoolTimeout

from octasplat.service.actions.access import fetch_visible_dataset
from octasplat.service.actions.pages import Page, page_of
from octasplat.service.auth import Principal
from octasplat.service.idempotency import create_once, fingerprint
from octasplat.service.intake.dataset import DatasetFile as IntakeFile
from octasplat.service.intake.dataset import DatasetSummary, check_dataset
from octasplat.service.intake.input_files import check_input_files
from octasplat.service.schemas.datasets import DatasetChange, NewDataset
from octasplat.service.state import Service
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.workers.db import datasets as rows
from octasplat.workers.db.connections import retry_on_deadlock
from octasplat.workers.db.errors import ConflictError
from octasplat.workers.db.quotas import check_new_dataset
from octasplat.workers.db.rows import Dataset, DatasetFile

MAX_END_CHECK_SECONDS = 60.0
"""For so long it is tried to say what a check found."""


@retry_on_deadlock
async def create_dataset(
    service: Service, principal: Principal, new: NewDataset, *, idempotency_key: str | None = None
) -> Dataset:
    """Create a dataset; a repetition with the same ``idempotency_key`` creates nothing.

    Raises:
        ProblemError: 422 if the key was used for another request.
        QuotaExceededError: the asker has too many.
    """
    async with service.pool.connection() as connection, connection.transaction():

        async def make() -> uuid.UUID:
            await check_new_dataset(connection, principal.owner, service.settings.quota)
            return (await rows.create_dataset(connection, principal.owner, new.name, new.holds)).id

        request = fingerprint("dataset", new.model_dump(exclude=set() if new.holds == "files" else {"holds"}))
        dataset_id, _ = await create_once(connection, principal, idempotency_key, request, make)
        return await fetch_visible_dataset(connection, principal, dataset_id)


async def list_datasets(
    service: Service, principal: Principal, *, before: uuid.UUID | None = None, limit: int
) -> Page[Dataset]:
    """Return the datasets before ``before`` that the principal may see, newest first."""
    async with service.pool.connection() as connection:
        found = await rows.list_datasets(
            connection, owner=principal.visible_owner, before=before, limit=limit + 1
        )
    return page_of(found, limit, lambda dataset: dataset.id)


async def list_files_by_suffix(
    service: Service, principal: Principal, suffixes: Sequence[str], *, limit: int
) -> list[tuple[Dataset, str]]:
    """Return files, by suffix, of the owner's committed datasets for options; newest first."""
    async with service.pool.connection() as connection:
        return await rows.list_files_by_suffix(connection, principal.owner, suffixes, limit=limit)


async def get_dataset(service: Service, principal: Principal, dataset_id: uuid.UUID) -> Dataset:
    """Return the dataset with that id, if the principal may see it.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        return await fetch_visible_dataset(connection, principal, dataset_id)


@retry_on_deadlock
async def change_dataset(
    service: Service,
    principal: Principal,
    dataset_id: uuid.UUID,
    change: DatasetChange,
    check: Callable[[Dataset], None] = lambda _: None,
) -> Dataset:
    """Rename a dataset, or pin it so that it does not expire.

    Args:
        service: the service.
        principal: asks.
        dataset_id: the dataset.
        change: what is to be different.
        check: sees the dataset as it is, while nobody else can change it, and raises to leave it so.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection, connection.transaction():
        dataset = await fetch_visible_dataset(connection, principal, dataset_id, lock=True)
        check(dataset)
        return await rows.change_dataset(
            connection,
            dataset_id,
            name=dataset.name if change.name is None else change.name,
            pinned=dataset.pinned if change.pinned is None else change.pinned,
        )


@retry_on_deadlock
async def delete_dataset(service: Service, principal: Principal, dataset_id: uuid.UUID) -> None:
    """Delete a dataset.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
        ConflictError: a job needs it.
    """
    async with service.pool.connection() as connection:
        await fetch_visible_dataset(connection, principal, dataset_id)
        await rows.delete_dataset(connection, dataset_id)
    service.evictor.evict_if_low_later()


async def commit_dataset(service: Service, principal: Principal, dataset_id: uuid.UUID) -> Dataset:
    """Validate a dataset and commit it; a committed one never changes again.

    Raises:
        ProblemError: 404; 429 with too many that wait to be checked.
        ConflictError: it is being checked.
        IntakeError: it is not sound.
    """
    async with service.pool.connection() as connection:
        owner = (await fetch_visible_dataset(connection, principal, dataset_id)).owner
    async with service.check_limiter.limited(owner):
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
        known = [_intake_file(f) for f in files]
        if before.holds == "files":
            summary = check_input_files(known)
        else:
            limits = service.settings.dataset_limits()
            summary = await run_in_pool(ThreadPurpose.CHECKS, check_dataset, service.storage, known, limits)
    finally:
        renewing.cancel()
        # Whatever happens, the dataset must not stay closed.
        dataset = await asyncio.shield(_end_check(service, check, summary))
    if dataset.state != "committed":
        raise ConflictError("The dataset was opened while it was checked; commit it again.")
    return dataset


async def _renew_check(service: Service, check: rows.Check) -> None:
    """Renew the validation regularly; without that it counts as abandoned."""
    while True:
        await asyncio.sleep(rows.STALE_CHECK_SECONDS / 6)
        with suppress(psycopg.Error, PoolTimeout):
            async with service.pool.connection() as connection:
                await rows.renew_check(connection, check)


async def _end_check(
    service: Service, check: rows.Check, summary: DatasetSummary | dict[str, Any] | None
) -> Dataset:
    """Record the result of the validation, with retries while the database is away."""
    wait, deadline = 0.2, time.monotonic() + MAX_END_CHECK_SECONDS
    while True:
        try:
            return await _record_check(service, check, summary)
        except (psycopg.OperationalError, psycopg.InterfaceError, PoolTimeout):
            if time.monotonic() > deadline:
                raise  # whoever looks after lost checks opens it
        await asyncio.sleep(wait)
        wait = min(2 * wait, 5.0)


async def _record_check(
    service: Service, check: rows.Check, summary: DatasetSummary | dict[str, Any] | None
) -> Dataset:
    async with service.pool.connection() as connection:
        if summary is None:
            return await rows.end_check(connection, check, is_valid=False)
        if isinstance(summary, dict):
            return await rows.end_check(connection, check, is_valid=True, facts=summary)
        facts: dict[str, Any] = asdict(summary)
        photographs, has_poses = facts.pop("photographs"), facts.pop("has_model")
        return await rows.end_check(
            connection, check, is_valid=True, has_poses=has_poses, photographs=photographs, facts=facts
        )


def _intake_file(row: DatasetFile) -> IntakeFile:
    return IntakeFile(
        row.path,
        row.sha256,
        row.size_bytes,
        row.facts.get("width_px"),
        row.facts.get("height_px"),
        row.facts.get("warning"),
    )
