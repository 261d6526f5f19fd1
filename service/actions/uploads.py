"""Files of datasets: uploaded one by one or as an archive, listed, read, removed."""

import logging
import uuid
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from octasplat.service.actions.access import (
    check_not_draining,
    check_searchable_name,
    fetch_visible_dataset,
    open_dataset,
)
from octasplat.service.actions.pages import Page, page_of
from octasplat.service.auth import Principal
from octasplat.service.intake.dataset import check_file_content
from octasplat.service.intake.input_files import check_input_content, check_input_name
from octasplat.service.intake.receive import (
    ContentCheck,
    ReceivedArchive,
    ReceivedFile,
    receive_archive,
    receive_file,
)
from octasplat.service.intake.upload_names import check_file_name
from octasplat.service.problems import ProblemError, not_found_error
from octasplat.service.state import Service
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.workers.db import datasets as rows
from octasplat.workers.db.connections import retry_on_deadlock
from octasplat.workers.db.quotas import QuotaExceededError, bytes_left, check_bytes, owned_bytes
from octasplat.workers.db.rows import Dataset, DatasetFile
from octasplat.workers.db.uploads import FileUpload, delete_upload
from octasplat.workers.queue.storage_leases import StorageLease
from octasplat.workers.storage.errors import BlobNotFoundError, ContentTooLargeError
from octasplat.workers.storage.protocol import Storage

logger = logging.getLogger(__name__)
ReceivedT = TypeVar("ReceivedT")
MAX_LEFT_OUT = 1000
"""Names of files left out that a task lists at most."""


@dataclass(frozen=True)
class Upload:
    """An upload in progress.

    Attributes:
        body: its bytes, as they come.
        sha256: the digest that was announced.
        size_bytes: the length that was announced.
        parts: the upload whose parts are this body, and go when it is stored.
    """

    body: AsyncIterator[bytes]
    sha256: str | None = None
    size_bytes: int | None = None
    parts: FileUpload | None = None

    @property
    def part_bytes(self) -> int:
        """Return how much of what is stored goes with the parts."""
        return 0 if self.parts is None else self.parts.size_bytes


@dataclass(frozen=True)
class StoredFile:
    """A file of a dataset, and whether it was there already."""

    row: DatasetFile
    is_unchanged: bool


@dataclass(frozen=True)
class StoredArchive:
    """Files that came out of an archive, names of those that are left out, and sentences on them."""

    files: list[DatasetFile]
    left_out: tuple[str, ...]
    notes: tuple[str, ...]


async def list_files(
    service: Service, principal: Principal, dataset_id: uuid.UUID, *, after: str, limit: int
) -> Page[DatasetFile]:
    """Return the uploaded files after ``after``, by name.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        await fetch_visible_dataset(connection, principal, dataset_id)
        found = await rows.files_of(connection, dataset_id, after=after, limit=limit + 1)
    return page_of(found, limit, lambda file: file.path)


async def get_file(service: Service, principal: Principal, dataset_id: uuid.UUID, path: str) -> DatasetFile:
    """Return a file of a dataset.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        await fetch_visible_dataset(connection, principal, dataset_id)
        row = await rows.get_file(connection, dataset_id, check_searchable_name(path, "file"))
    if row is None:
        raise not_found_error("file")
    return row


@retry_on_deadlock
async def remove_file(service: Service, principal: Principal, dataset_id: uuid.UUID, path: str) -> None:
    """Remove a file from an open dataset.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
        ConflictError: the dataset is not open.
    """
    async with service.pool.connection() as connection:
        await open_dataset(connection, principal, dataset_id)
        if not await rows.remove_file(connection, dataset_id, check_searchable_name(path, "file")):
            raise not_found_error("file")
    service.evictor.evict_if_low_later()


async def put_file(
    service: Service, principal: Principal, dataset_id: uuid.UUID, path: str, upload: Upload
) -> StoredFile:
    """Store a file in an open dataset; the body is not read if the announced content is there.

    Raises:
        ProblemError: 404, or 503 if the service is about to stop.
        ConflictError: the dataset is not open.
        IntakeError: the name or the content is refused.
        QuotaExceededError: its owner may not store as much.
        StorageError: it is not as announced, or there is no room.
    """
    check_not_draining(service)
    return await _store_file(service, principal, dataset_id, path, upload)


async def _store_file(
    service: Service, principal: Principal, dataset_id: uuid.UUID, path: str, upload: Upload
) -> StoredFile:
    async with service.pool.connection() as connection:
        dataset = await open_dataset(connection, principal, dataset_id)
        check = check_file_name_of(dataset, path)
        known = await rows.get_file(connection, dataset_id, path)
        left = await bytes_left(connection, dataset.owner, service.settings.quota)
        had = await owned_bytes(connection, dataset.owner, upload.sha256) if upload.sha256 is not None else 0
    if known is not None and upload.sha256 == known.sha256:
        if await run_in_pool(ThreadPurpose.UPLOADS, _is_stored, service.storage, known):
            return StoredFile(known, is_unchanged=True)
        logger.warning("the store lost %s of dataset %s, which is sent again", path, dataset_id)
    if left is not None:
        # What it replaces goes, and content that its owner has already counts once.
        left += had + (known.size_bytes if known is not None else 0) + upload.part_bytes

    def receive() -> Awaitable[ReceivedFile]:
        return receive_file(
            service.storage,
            path,
            upload.body,
            sha256=upload.sha256,
            size_bytes=upload.size_bytes,
            limits=service.settings.upload_limits(),
            max_bytes=left,
            check=check,
        )

    async with service.evictor.upload_lease(upload.size_bytes) as note:
        received = await _limited_by_quota(receive, left)
        [row] = await _record_files(service, dataset, note, [received], upload.parts)
    return StoredFile(row, is_unchanged=False)


async def put_archive(
    service: Service, principal: Principal, dataset_id: uuid.UUID, upload: Upload
) -> StoredArchive:
    """Store the files of a ZIP file in an open dataset, beside those that are there.

    Raises:
        ProblemError: 404, or 503 if the service is about to stop.
        ConflictError: the dataset is not open.
        IntakeError: the archive, or a name or a content in it, is refused.
        QuotaExceededError: its owner may not store as much.
        StorageError: it is not as announced, or there is no room.
    """
    check_not_draining(service)
    return await _store_archive(service, principal, dataset_id, upload)


async def _store_archive(
    service: Service, principal: Principal, dataset_id: uuid.UUID, upload: Upload
) -> StoredArchive:
    async with service.pool.connection() as connection:
        dataset = await open_dataset(connection, principal, dataset_id)
        left = await bytes_left(connection, dataset.owner, service.settings.quota)
        known = await rows.files_of(connection, dataset_id)
    check_takes_archives(dataset)
    if left is not None:
        # What it replaces goes, all of it where the archive is sent again; the exact count comes at the end.
        left += sum(file.size_bytes for file in known) + upload.part_bytes

    def receive() -> Awaitable[ReceivedArchive]:
        return receive_archive(
            service.storage,
            upload.body,
            service.spool_space,
            owner=principal.owner,
            sha256=upload.sha256,
            size_bytes=upload.size_bytes,
            limits=service.settings.upload_limits(),
            max_bytes=left,
        )

    async with service.evictor.upload_lease(upload.size_bytes) as note:
        received = await _limited_by_quota(receive, left)
        files = await _record_files(service, dataset, note, received.files, upload.parts)
    return StoredArchive(files, received.left_out, received.notes)


def _is_stored(storage: Storage, file: DatasetFile) -> bool:
    """Return whether the storage holds the content of a file, without reading it."""
    try:
        return storage.stat(file.sha256).size_bytes == file.size_bytes
    except BlobNotFoundError:
        return False


async def store_named(
    service: Service, principal: Principal, dataset_id: uuid.UUID, path: str | None, upload: Upload
) -> dict[str, Any]:
    """Store a file, or a ZIP file's if ``path`` is None; returns what a task tells of it.

    Also while the service is about to stop, as the task goes on elsewhere if it does not end here.

    Raises:
        Exception: as by :func:`put_file` and :func:`put_archive`.
    """
    if path is not None:
        await _store_file(service, principal, dataset_id, path, upload)
        return {"files": 1, "left_out": [], "notes": []}
    stored = await _store_archive(service, principal, dataset_id, upload)
    left_out = list(stored.left_out[:MAX_LEFT_OUT])
    return {"files": len(stored.files), "left_out": left_out, "notes": list(stored.notes)}


def check_takes_archives(dataset: Dataset) -> None:
    """Refuse an archive for a dataset that takes single files.

    Raises:
        ProblemError: 409.
    """
    if dataset.holds == "files":
        raise ProblemError(
            409, "holds-files", "Files that options name are sent one by one, not as an archive."
        )


def check_file_name_of(dataset: Dataset, path: str) -> ContentCheck:
    """Return the content check for a valid file name.

    Raises:
        IntakeError: a dataset of this kind takes no file of that name.
    """
    if dataset.holds == "files":
        check_input_name(path)
        return check_input_content
    check_file_name(path)
    return check_file_content


async def _limited_by_quota(receive: Callable[[], Awaitable[ReceivedT]], bytes_left: int | None) -> ReceivedT:
    """Run ``receive``; if it exceeds ``bytes_left``, raise the owner's quota error."""
    try:
        return await receive()
    except ContentTooLargeError as error:
        # Of the two limits the error names the one that was exceeded.
        if bytes_left is None or error.max_bytes != bytes_left:
            raise
        raise QuotaExceededError(
            "bytes", f"{bytes_left} bytes are left of what you may store; delete datasets or jobs first."
        ) from None


@retry_on_deadlock
async def _record_files(
    service: Service,
    dataset: Dataset,
    lease: StorageLease,
    received: Sequence[ReceivedFile],
    parts: FileUpload | None,
) -> list[DatasetFile]:
    """Record stored files in the dataset, all or none, in the place of the parts that they came in."""
    new = [rows.NewFile(f.path, f.blob.sha256, f.blob.size_bytes, f.facts) for f in received]
    async with lease.reference({file.sha256 for file in new}) as connection:
        if parts is not None:
            await delete_upload(connection, parts)
        files = await rows.put_files(connection, dataset.id, new)
        await check_bytes(connection, dataset.owner, service.settings.quota)
    service.metrics.upload_bytes.inc(sum(file.blob.size_bytes for file in received))
    return files
