"""Checks of ownership, and of whether the service accepts work at present."""

import uuid
from typing import Protocol, TypeVar

from octasplat.service.auth import Principal
from octasplat.service.problems import ProblemError, not_found_error
from octasplat.service.state import Service
from octasplat.workers.db.connections import Connection
from octasplat.workers.db.datasets import get_dataset
from octasplat.workers.db.errors import ConflictError
from octasplat.workers.db.rows import Dataset, Job
from octasplat.workers.maintenance.webhooks.rows import Endpoint, get_webhook_endpoint
from octasplat.workers.queue.jobs import get_job

_RETRY_SECONDS = 10


async def fetch_visible_job(
    connection: Connection, principal: Principal, job_id: uuid.UUID, *, lock: bool = False
) -> Job:
    """Return the job if the principal may see it.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    return _if_visible(principal, await get_job(connection, job_id, lock=lock), "job")


async def read_job(service: Service, principal: Principal, job_id: uuid.UUID) -> Job:
    """Return the job if the principal may see it, on a connection of its own."""
    async with service.pool.connection() as connection:
        return await fetch_visible_job(connection, principal, job_id)


async def fetch_visible_dataset(
    connection: Connection, principal: Principal, dataset_id: uuid.UUID, *, lock: bool = False
) -> Dataset:
    """Return the dataset if the principal may see it.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    return _if_visible(principal, await get_dataset(connection, dataset_id, lock=lock), "dataset")


async def open_dataset(connection: Connection, principal: Principal, dataset_id: uuid.UUID) -> Dataset:
    """Return the dataset if the principal may see it and it still takes files.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
        ConflictError: it is committed, or being checked.
    """
    dataset = await fetch_visible_dataset(connection, principal, dataset_id)
    if dataset.state != "open":
        raise ConflictError(
            f"The dataset is {dataset.state}, so its files do not change; make a new dataset."
        )
    return dataset


async def fetch_visible_webhook(
    connection: Connection, principal: Principal, webhook_id: uuid.UUID, *, lock: bool = False
) -> Endpoint:
    """Return the webhook if the principal may see it.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    return _if_visible(principal, await get_webhook_endpoint(connection, webhook_id, lock=lock), "webhook")


class _Owned(Protocol):
    @property
    def owner(self) -> str: ...


_OwnedT = TypeVar("_OwnedT", bound=_Owned)


def _if_visible(principal: Principal, row: _OwnedT | None, kind: str) -> _OwnedT:
    if row is None or not principal.may_see(row.owner):
        raise not_found_error(kind)
    return row


def check_searchable_name(name: str, kind: str) -> str:
    """Return a name to search for, if the database can hold it.

    Raises:
        ProblemError: 404, as nothing has a name that the database cannot hold.
    """
    if "\0" in name:
        raise not_found_error(kind)
    return name


def check_not_draining(service: Service) -> None:
    """Refuse work that may not be finished before the service stops.

    Raises:
        ProblemError: 503.
    """
    if service.is_draining:
        raise ProblemError(503, "draining", "The service is about to stop.", retry_seconds=_RETRY_SECONDS)
