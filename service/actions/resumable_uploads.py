"""Uploads of one large file each that go on after a break, as the tus protocol has it.

Libraries for it keep the file on the front end's disk, beside quotas, and beside other front ends. Here its
parts are contents of the store, each durable as soon as it is counted; the whole is stored by a task.
"""

import uuid
from collections.abc import AsyncIterator, Sequence
from contextlib import aclosing
from dataclasses import dataclass
from functools import partial

from octasplat.engine.core.errors import OctasplatError
from octasplat.service.actions import uploads
from octasplat.service.actions.access import check_not_draining, fetch_visible_dataset, open_dataset
from octasplat.service.actions.dataset_tasks import TaskOutcome, new_task
from octasplat.service.actions.uploads import Upload
from octasplat.service.auth import Principal
from octasplat.service.idempotency import create_once, fingerprint
from octasplat.service.intake.receive import receive_parts
from octasplat.service.problems import ProblemError, not_found_error, problem_from_error
from octasplat.service.settings import MAX_UPLOADS
from octasplat.service.state import Service
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.workers.db import uploads as rows
from octasplat.workers.db.connections import Connection, retry_on_deadlock
from octasplat.workers.db.dataset_tasks import DatasetTask, get_task
from octasplat.workers.db.datasets import get_dataset
from octasplat.workers.db.errors import ConflictError
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.db.quotas import QuotaExceededError, bytes_left, check_bytes
from octasplat.workers.db.rows import Dataset
from octasplat.workers.db.uploads import FileUpload, UploadPart
from octasplat.workers.storage.errors import ContentTooLargeError, StorageFullError, StorageUnavailableError
from octasplat.workers.storage.protocol import Storage

_RETRY_SECONDS = 60
_READ_BYTES = 1 << 20


@dataclass(frozen=True)
class NewUpload:
    """An upload that is announced.

    Attributes:
        size_bytes: length of the file.
        path: its name in the dataset; None for a ZIP file that is unpacked.
        sha256: its digest.
        metadata: what the client said of it, as it said it.
    """

    size_bytes: int
    path: str | None
    sha256: str | None
    metadata: str


@retry_on_deadlock
async def create_upload(
    service: Service,
    principal: Principal,
    dataset_id: uuid.UUID,
    new: NewUpload,
    *,
    idempotency_key: str | None = None,
) -> FileUpload:
    """Create an upload; a repetition with the same ``idempotency_key`` goes on with it.

    Raises:
        ProblemError: 404, 429 with too many that are not finished.
        ConflictError: the dataset is not open.
        IntakeError: the name of the file is refused.
        ContentTooLargeError: the file is too long.
        QuotaExceededError: its owner may not store as much.
    """
    check_not_draining(service)
    async with service.pool.connection() as connection, connection.transaction():
        dataset = await open_dataset(connection, principal, dataset_id)
        _check_announced(service, dataset, new)

        async def make() -> uuid.UUID:
            await lock_owner(connection, dataset.owner)
            await _check_room(service, connection, dataset.owner, new.size_bytes)
            return await rows.add_upload(
                connection, dataset.id, dataset.owner, path=new.path, size_bytes=new.size_bytes,
                sha256=new.sha256, metadata=new.metadata,
            )  # fmt: skip

        request = fingerprint("upload", str(dataset_id), new.size_bytes, new.metadata)
        upload_id, _ = await create_once(connection, principal, idempotency_key, request, make)
        upload = await rows.get_upload(connection, upload_id)
    if upload is None:
        raise not_found_error("upload")
    return upload


async def get_upload(
    service: Service, principal: Principal, dataset_id: uuid.UUID, upload_id: uuid.UUID
) -> FileUpload:
    """Return an upload, with how much of it has come.

    Raises:
        ProblemError: 404 if it does not exist, is stored, or the principal may not see it.
    """
    async with service.pool.connection() as connection:
        await fetch_visible_dataset(connection, principal, dataset_id)
        return await upload_in(connection, dataset_id, upload_id)


async def continue_upload(
    service: Service, principal: Principal, dataset_id: uuid.UUID, upload_id: uuid.UUID, *,
    offset_bytes: int, body: AsyncIterator[bytes],
) -> FileUpload:  # fmt: skip
    """Store more of an upload; when all of it has come, a task stores the file.

    What has come is kept also where the body breaks off.

    Raises:
        ProblemError: 404; 503 if the service is about to stop.
        ConflictError: the dataset is not open, or the upload has come as far as another offset.
        IntakeError: nothing came for too long.
        QuotaExceededError: its owner may not store as much.
        StorageError: there is no room, or more comes than was announced.
    """
    check_not_draining(service)
    async with service.pool.connection() as connection:
        await open_dataset(connection, principal, dataset_id)
        upload = await upload_in(connection, dataset_id, upload_id)
    if upload.offset_bytes != offset_bytes:
        raise ConflictError(f"{upload.offset_bytes} bytes of the upload have come; go on behind them.")
    left = upload.size_bytes - offset_bytes
    limits = service.settings.upload_limits()
    if left:
        async with (
            service.evictor.upload_lease(left) as lease,
            aclosing(receive_parts(service.storage, body, max_bytes=left, limits=limits)) as parts,
        ):
            # Each part counts by itself, so that a break loses only what came after the last one.
            async for blob in parts:
                part = UploadPart(offset_bytes, blob.sha256, blob.size_bytes)
                async with lease.reference({blob.sha256}) as connection:
                    await rows.add_part(connection, upload, part)
                    await check_bytes(connection, upload.owner, service.settings.quota)
                offset_bytes += blob.size_bytes
    return await store_if_whole(service, upload)


@retry_on_deadlock
async def delete_upload(
    service: Service, principal: Principal, dataset_id: uuid.UUID, upload_id: uuid.UUID
) -> None:
    """Delete an upload with what has come of it.

    Raises:
        ProblemError: 404 if it does not exist or the principal may not see it.
        ConflictError: its file is being stored.
    """
    async with service.pool.connection() as connection, connection.transaction():
        await fetch_visible_dataset(connection, principal, dataset_id)
        upload = await upload_in(connection, dataset_id, upload_id)
        await lock_owner(connection, upload.owner)
        upload = await upload_in(connection, dataset_id, upload_id, lock=True)
        if await _is_being_stored(connection, upload):
            raise ConflictError("All of the upload has come, and the file is being stored.")
        await rows.delete_upload(connection, upload)
    service.evictor.evict_if_low_later()


async def run_upload(service: Service, task: DatasetTask) -> TaskOutcome:
    """Store the file of an upload; its parts go, unless that can be tried again.

    As where room was lacking, or the dataset is being checked and will be open again if that finds faults.
    """
    async with service.pool.connection() as connection:
        upload = await rows.get_upload(connection, uuid.UUID(task.request["upload_id"]))
        if upload is None:
            return TaskOutcome()  # a process that was lost has stored it
        parts = await rows.parts_of(connection, upload.id)
    body = Upload(_content(service.storage, parts), upload.sha256, upload.size_bytes, upload)
    owner = Principal(task.owner, frozenset({"write"}), task.id)
    delete = partial(_delete, upload=upload)
    try:
        result = await uploads.store_named(service, owner, task.dataset_id, upload.path, body)
    except (ConflictError, StorageFullError, StorageUnavailableError) as error:
        return TaskOutcome(problem=problem_from_error(error))
    except OctasplatError as error:
        return TaskOutcome(problem=problem_from_error(error), apply=delete)
    return TaskOutcome(result, apply=delete)


async def _delete(connection: Connection, upload: FileUpload) -> None:
    await rows.delete_upload(connection, upload)


async def _content(storage: Storage, parts: Sequence[UploadPart]) -> AsyncIterator[bytes]:
    """Yield the content of an upload, in pieces."""
    for part in parts:
        with await run_in_pool(ThreadPurpose.UPLOADS, storage.open, part.sha256) as file:
            while piece := await run_in_pool(ThreadPurpose.UPLOADS, file.read, _READ_BYTES):
                yield piece


@retry_on_deadlock
async def store_if_whole(service: Service, upload: FileUpload) -> FileUpload:
    """Begin the task that stores an upload of which all has come, again if the last one failed.

    Returns:
        The upload as it is.

    Raises:
        ProblemError: 404.
    """
    async with service.pool.connection() as connection, connection.transaction():
        # Of two requests that bring the end at once, only one begins the task.
        found = await rows.get_upload(connection, upload.id, lock=True)
        if found is None:
            raise not_found_error("upload")
        if found.offset_bytes == found.size_bytes and not await _is_being_stored(connection, found):
            dataset = await get_dataset(connection, found.dataset_id)
            assert dataset is not None
            task = await new_task(service, connection, dataset, "upload", {"upload_id": str(found.id)})
            await rows.set_task(connection, found.id, task.id)
            found = await rows.get_upload(connection, found.id)
            assert found is not None
        return found


def _check_announced(service: Service, dataset: Dataset, new: NewUpload) -> None:
    settings = service.settings
    if new.path is None:
        uploads.check_takes_archives(dataset)
    else:
        uploads.check_file_name_of(dataset, new.path)
    most = settings.max_archive_bytes if new.path is None else settings.max_upload_bytes
    if new.size_bytes > most:
        raise ContentTooLargeError(f"The file has {new.size_bytes} bytes; {most} are allowed.", most)


async def _check_room(service: Service, connection: Connection, owner: str, size_bytes: int) -> None:
    if await rows.count_uploads(connection, owner) >= MAX_UPLOADS:
        detail = f"{MAX_UPLOADS} uploads are unfinished; finish or delete one."
        raise ProblemError(429, "busy", detail, retry_seconds=_RETRY_SECONDS)
    left = await bytes_left(connection, owner, service.settings.quota)
    if left is not None and size_bytes > left:
        raise QuotaExceededError(
            "bytes", f"{left} bytes are left of what you may store; delete datasets or jobs first."
        )


async def _is_being_stored(connection: Connection, upload: FileUpload) -> bool:
    """Return whether a task on an upload waits or is worked on."""
    task = None if upload.task_id is None else await get_task(connection, upload.task_id)
    return task is not None and not task.is_over


async def upload_in(
    connection: Connection, dataset_id: uuid.UUID, upload_id: uuid.UUID, *, lock: bool = False
) -> FileUpload:
    """Return an upload into a dataset.

    Raises:
        ProblemError: 404.
    """
    upload = await rows.get_upload(connection, upload_id, lock=lock)
    if upload is None or upload.dataset_id != dataset_id:
        raise not_found_error("upload")
    return upload
