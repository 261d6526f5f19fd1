"""Files of an open dataset whose content its owner has stored before, taken over without being sent.

Only contents of the dataset's owner are looked at, so that nobody learns what others have stored.
"""

import asyncio
import uuid
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from octasplat.service.actions.access import check_not_draining, open_dataset
from octasplat.service.actions.uploads import check_file_name_of
from octasplat.service.auth import Principal
from octasplat.service.intake.faults import IntakeError, IntakeFault
from octasplat.service.intake.receive import ContentCheck, header_facts
from octasplat.service.state import Service
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.workers.db import datasets as rows
from octasplat.workers.db.connections import retry_on_deadlock
from octasplat.workers.db.quotas import check_bytes, owned_contents
from octasplat.workers.db.rows import Dataset, DatasetFile
from octasplat.workers.queue.storage_leases import StorageLease, contents_being_removed, storage_lease
from octasplat.workers.storage.errors import (
    BlobNotFoundError,
    ContentTooLargeError,
    StorageUnavailableError,
)

MAX_TRIES = 3
"""So often it is looked anew which contents are there, as some were removed meanwhile."""
_PARALLEL_LOOKS = 4
"""Files of one request that are looked at at once; other requests need threads too."""


@dataclass(frozen=True)
class WantedFile:
    """A file that a client has: its name in the dataset, and the digest of its content."""

    path: str
    sha256: str


@dataclass(frozen=True)
class ReusedFiles:
    """The files that are in the dataset now, and the names of those that have to be sent."""

    files: list[DatasetFile]
    missing: list[str]


async def reuse_files(
    service: Service, principal: Principal, dataset_id: uuid.UUID, wanted: Sequence[WantedFile]
) -> ReusedFiles:
    """Record files in an open dataset whose contents its owner has; the others are to be sent.

    Contents are checked as if they had been sent. Each is named in the dataset in the transaction that finds
    it not being removed, so it stays however soon whatever else names it is deleted.

    Raises:
        ProblemError: 404, or 503 if the service is about to stop.
        ConflictError: the dataset is not open.
        IntakeError: a name, or what is stored, is refused.
        QuotaExceededError: its owner may not store as much.
        StorageError: a file is too long, or the store does not answer.
    """
    check_not_draining(service)
    async with service.pool.connection() as connection:
        dataset = await open_dataset(connection, principal, dataset_id)
    check = _check_names(dataset, wanted)
    for tries_left in reversed(range(MAX_TRIES)):
        # A lease that is older than the look at the store notices each removal after it.
        async with storage_lease(service.pool, service.storage) as lease:
            sizes = await _available_contents(service, dataset.owner, {file.sha256 for file in wanted})
            found = await _look_at(service, [file for file in wanted if file.sha256 in sizes], sizes, check)
            try:
                files = await _record_files(service, dataset, lease, found) if found else []
            except StorageUnavailableError:
                if tries_left:
                    continue
                raise
        there = {file.path for file in files}
        return ReusedFiles(files, [file.path for file in wanted if file.path not in there])
    raise AssertionError("the last try returns or raises")


def _check_names(dataset: Dataset, wanted: Sequence[WantedFile]) -> ContentCheck | None:
    """Return what looks at the contents; None for no files.

    Raises:
        IntakeError: with all names that are refused.
    """
    check, faults = None, list[IntakeFault]()
    for file in wanted:
        try:
            check = check_file_name_of(dataset, file.path)
        except IntakeError as error:
            faults += error.faults
    if faults:
        raise IntakeError(*faults)
    return check


async def _available_contents(service: Service, owner: str, contents: set[str]) -> dict[str, int]:
    """Return the lengths of those contents that an owner has and that are not being removed."""
    async with service.pool.connection() as connection:
        sizes = await owned_contents(connection, owner, contents)
        for sha256 in await contents_being_removed(connection, list(sizes)):
            del sizes[sha256]
    return sizes


async def _look_at(
    service: Service, wanted: Sequence[WantedFile], sizes: dict[str, int], check: ContentCheck | None
) -> list[rows.NewFile]:
    """Return those files that the store holds, as they are recorded.

    Raises:
        IntakeError: with all faults of their contents.
        StorageError: one is too long, or the store does not answer.
    """
    found, faults = list[rows.NewFile](), list[IntakeFault]()

    async def look_at_some(files: Iterator[WantedFile]) -> None:
        for file in files:
            try:
                new = await run_in_pool(
                    ThreadPurpose.UPLOADS, _stored_file, service, file, sizes[file.sha256], check
                )
            except IntakeError as error:
                faults.extend(error.faults)
            else:
                found.extend([] if new is None else [new])

    left = iter(wanted)  # all take from the same
    results = await asyncio.gather(
        *(look_at_some(left) for _ in range(_PARALLEL_LOOKS)), return_exceptions=True
    )
    for result in results:
        if result is not None:
            raise result
    if faults:
        raise IntakeError(*faults)
    return found


def _stored_file(
    service: Service, file: WantedFile, size_bytes: int, check: ContentCheck | None
) -> rows.NewFile | None:
    """Return a file as it is recorded; None where the store has lost its content, or a part of it."""
    limits = service.settings.upload_limits()
    if size_bytes > limits.max_file_bytes:
        detail = f"The file has {size_bytes} bytes; {limits.max_file_bytes} are allowed."
        raise ContentTooLargeError(detail, limits.max_file_bytes)
    try:
        if service.storage.stat(file.sha256).size_bytes != size_bytes:
            return None
        assert check is not None
        header = check(service.storage, file.path, file.sha256, limits.dataset.image)
    except BlobNotFoundError:
        return None
    return rows.NewFile(file.path, file.sha256, size_bytes, header_facts(header))


@retry_on_deadlock
async def _record_files(
    service: Service, dataset: Dataset, lease: StorageLease, found: Sequence[rows.NewFile]
) -> list[DatasetFile]:
    async with lease.reference({file.sha256 for file in found}) as connection:
        files = await rows.put_files(connection, dataset.id, found)
        await check_bytes(connection, dataset.owner, service.settings.quota)
    return files
