"""Datasets: created, listed, changed, deleted; see ``uploads`` for their files, ``commits`` for commits."""

import uuid
from collections.abc import Callable, Sequence

from octasplat.service.actions.access import fetch_visible_dataset
from octasplat.service.actions.pages import Page, page_of
from octasplat.service.auth import Principal
from octasplat.service.idempotency import create_once, fingerprint
from octasplat.service.schemas.datasets import DatasetChange, NewDataset
from octasplat.service.state import Service
from octasplat.workers.db import datasets as rows
from octasplat.workers.db.connections import retry_on_deadlock
from octasplat.workers.db.quotas import check_new_dataset
from octasplat.workers.db.rows import Dataset


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

        # A request that does not say what the dataset holds is the same as one for photographs.
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
