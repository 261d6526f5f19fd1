"""Files of datasets: taken in one by one or as an archive, listed, found, taken out."""

import logging
import uuid
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from octasplat.service.actions.access import open_dataset, owned_dataset, refuse_while_draining, sought
from octasplat.service.actions.parts import Part, cut
from octasplat.service.auth import Principal
from octasplat.service.intake.dataset import check_file_content
from octasplat.service.intake.inputs import check_input_content, check_input_name
from octasplat.service.intake.names import check_file_name
from octasplat.service.intake.receive import (
    ContentCheck,
    ReceivedArchive,
    ReceivedFile,
    receive_archive,
    receive_file,
)
from octasplat.service.problems import Problem, not_found
from octasplat.service.state import Service
from octasplat.service.threads import Threads, in_thread
from octasplat.workers.queue.storing import Note
from octasplat.workers.records import datasets as rows
from octasplat.workers.records.database import tried_again
from octasplat.workers.records.quotas import QuotaExceeded, bytes_left, check_bytes, owned_bytes
from octasplat.workers.records.rows import Dataset, DatasetFile
from octasplat.workers.store.errors import BlobMissing, TooLarge
from octasplat.workers.store.protocol import Storage

logger = logging.getLogger(__name__)
Received = TypeVar("Received")


@dataclass(frozen=True)
class Upload:
    """Something that is being sent.

    Attributes:
        body: its bytes, as they come.
        sha256: the digest that was announced.
        size_bytes: the length that was announced.
    """

    body: AsyncIterator[bytes]
    sha256: str | None = None
    size_bytes: int | None = None


@dataclass(frozen=True)
class PutFile:
    """A file of a dataset, and whether it was there already."""

    row: DatasetFile
    was_there: bool


@dataclass(frozen=True)
class PutArchive:
    """Files that came out of an archive, and names of those that are no part of a scene."""

    files: list[DatasetFile]
    left_out: tuple[str, ...]


async def list_files(
    service: Service, who: Principal, dataset_id: uuid.UUID, *, after: str, limit: int
) -> Part[DatasetFile]:
    """The files that have arrived, by name, from the one after ``after``.

    Raises:
        Problem: 404.
    """
    async with service.pool.connection() as connection:
        await owned_dataset(connection, who, dataset_id)
        found = await rows.files_of(connection, dataset_id, after=after, limit=limit + 1)
    return cut(found, limit, lambda file: file.path)


async def get_file(service: Service, who: Principal, dataset_id: uuid.UUID, path: str) -> DatasetFile:
    """A file of a dataset.

    Raises:
        Problem: 404.
    """
    async with service.pool.connection() as connection:
        await owned_dataset(connection, who, dataset_id)
        row = await rows.get_file(connection, dataset_id, sought(path, "file"))
    if row is None:
        raise not_found("file")
    return row


@tried_again
async def remove_file(service: Service, who: Principal, dataset_id: uuid.UUID, path: str) -> None:
    """Take a file out of an open dataset.

    Raises:
        Problem: 404.
        Conflict: the dataset is not open.
    """
    async with service.pool.connection() as connection:
        await open_dataset(connection, who, dataset_id)
        if not await rows.remove_file(connection, dataset_id, sought(path, "file")):
            raise not_found("file")
    service.room.after_deletion()


async def put_file(
    service: Service, who: Principal, dataset_id: uuid.UUID, path: str, upload: Upload
) -> PutFile:
    """Put a file into an open dataset. One that is there with the announced digest is not read.

    Raises:
        Problem: 404, or 503 if the service is about to stop.
        Conflict: the dataset is not open.
        IntakeRefused: the name or the content is refused.
        QuotaExceeded: its owner may not store as much.
        StorageError: it is not as announced, or there is no room.
    """
    refuse_while_draining(service)
    async with service.pool.connection() as connection:
        dataset = await open_dataset(connection, who, dataset_id)
        check = _name_checked(dataset, path)
        known = await rows.get_file(connection, dataset_id, path)
        left = await bytes_left(connection, dataset.owner, service.settings.quota)
        had = await owned_bytes(connection, dataset.owner, upload.sha256) if upload.sha256 is not None else 0
    if known is not None and upload.sha256 == known.sha256:
        if await in_thread(Threads.UPLOADS, _is_held, service.storage, known):
            return PutFile(known, was_there=True)
        logger.warning("the store lost %s of dataset %s, which is sent again", path, dataset_id)
    if left is not None:
        # What it replaces goes, and content that its owner has already counts once.
        left += had + (known.size_bytes if known is not None else 0)

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

    async with service.room.upload(upload.size_bytes) as note:
        received = await _within_quota(receive, left)
        [row] = await _enter(service, dataset, note, [received])
    return PutFile(row, was_there=False)


async def put_archive(service: Service, who: Principal, dataset_id: uuid.UUID, upload: Upload) -> PutArchive:
    """Put the files of a ZIP file into an open dataset, beside those that are there.

    Raises:
        Problem: 404, or 503 if the service is about to stop.
        Conflict: the dataset is not open.
        IntakeRefused: the archive, or a name or a content in it, is refused.
        QuotaExceeded: its owner may not store as much.
        StorageError: it is not as announced, or there is no room.
    """
    refuse_while_draining(service)
    async with service.pool.connection() as connection:
        dataset = await open_dataset(connection, who, dataset_id)
        left = await bytes_left(connection, dataset.owner, service.settings.quota)
        known = await rows.files_of(connection, dataset_id)
    if dataset.holds == "files":
        raise Problem(409, "holds-files", "Files that options name are sent one by one, not as an archive.")
    if left is not None:
        # What it replaces goes, all of it where the archive is sent again; the exact count comes at the end.
        left += sum(file.size_bytes for file in known)

    def receive() -> Awaitable[ReceivedArchive]:
        return receive_archive(
            service.storage,
            upload.body,
            service.spool,
            sha256=upload.sha256,
            size_bytes=upload.size_bytes,
            limits=service.settings.upload_limits(),
            max_bytes=left,
        )

    async with service.room.upload(upload.size_bytes) as note:
        received = await _within_quota(receive, left)
        files = await _enter(service, dataset, note, received.files)
    return PutArchive(files, received.left_out)


def _is_held(storage: Storage, file: DatasetFile) -> bool:
    """Whether the store holds the content of a file, as far as can be seen without reading it."""
    try:
        return storage.stat(file.sha256).size_bytes == file.size_bytes
    except BlobMissing:
        return False


def _name_checked(dataset: Dataset, path: str) -> ContentCheck:
    """What looks at the content of a file whose name is taken; raises IntakeRefused where it is not."""
    if dataset.holds == "files":
        check_input_name(path)
        return check_input_content
    check_file_name(path)
    return check_file_content


async def _within_quota(receive: Callable[[], Awaitable[Received]], left: int | None) -> Received:
    """What an upload brings; ``left``, where that is what stopped it, is what its owner may still store."""
    try:
        return await receive()
    except TooLarge as error:
        if left is None or error.max_bytes != left:
            raise
        raise QuotaExceeded(
            "bytes", f"{left} bytes are left of what you may store; delete datasets or jobs first."
        ) from None


@tried_again
async def _enter(
    service: Service, dataset: Dataset, note: Note, received: Sequence[ReceivedFile]
) -> list[DatasetFile]:
    """Enter what is stored into the dataset, or none of it."""
    new = [rows.NewFile(f.path, f.blob.sha256, f.blob.size_bytes, f.facts) for f in received]
    async with note.naming({file.sha256 for file in new}) as connection:
        files = await rows.put_files(connection, dataset.id, new)
        await check_bytes(connection, dataset.owner, service.settings.quota)
    service.metrics.upload_bytes.inc(sum(file.blob.size_bytes for file in received))
    return files
