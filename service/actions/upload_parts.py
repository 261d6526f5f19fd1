"""Parts of one large file that come over several connections at once, in any order, each with its digest.

They are kept beside those that come in order, see :mod:`octasplat.service.actions.resumable_uploads`.
"""

import uuid

from octasplat.service.actions.access import check_not_draining, open_dataset
from octasplat.service.actions.resumable_uploads import store_if_whole, upload_in
from octasplat.service.actions.uploads import Upload
from octasplat.service.auth import Principal
from octasplat.service.intake import receive
from octasplat.service.problems import ProblemError
from octasplat.service.state import Service
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.workers.db import uploads as rows
from octasplat.workers.db.connections import retry_on_deadlock
from octasplat.workers.db.quotas import check_bytes
from octasplat.workers.db.uploads import FileUpload, UploadPart
from octasplat.workers.queue.storage_leases import StorageLease


async def parts_ahead(service: Service, upload: FileUpload) -> list[int]:
    """Return where parts of an upload begin that have come behind its offset; none once it is stored."""
    async with service.pool.connection() as connection:
        return [start for start, _ in await rows.parts_ahead(connection, upload)]


async def put_part(
    service: Service, principal: Principal, dataset_id: uuid.UUID, upload_id: uuid.UUID, *,
    start_bytes: int, body: Upload,
) -> FileUpload:  # fmt: skip
    """Store a part of an upload; when all have come, a task stores the file.

    Raises:
        ProblemError: 404; 409 for an upload without a digest; 422 for a place where none begins, or without a
            digest of the part; 503 if the service is about to stop.
        ConflictError: the dataset is not open, or other content has come there.
        IntakeError: nothing came for too long.
        QuotaExceededError: its owner may not store as much.
        StorageError: it is not as announced, or there is no room.
    """
    check_not_draining(service)
    async with service.pool.connection() as connection:
        await open_dataset(connection, principal, dataset_id)
        upload = await upload_in(connection, dataset_id, upload_id)
    if upload.sha256 is None:
        # Parts of different tries would be put together without anybody noticing.
        raise ProblemError(
            409, "conflict", "Parts in any order need the digest of the file in Upload-Metadata (sha256)."
        )
    if start_bytes % receive.PARALLEL_PART_BYTES or start_bytes >= upload.size_bytes:
        raise ProblemError(
            422,
            "part-start",
            f"Parts of this upload begin at multiples of {receive.PARALLEL_PART_BYTES} bytes.",
        )
    if body.sha256 is None:
        raise ProblemError(422, "digest-missing", "A part needs its digest, in the header Repr-Digest.")
    size_bytes = min(receive.PARALLEL_PART_BYTES, upload.size_bytes - start_bytes)
    if body.size_bytes not in (None, size_bytes):
        raise ProblemError(
            422, "part-size", f"The part at {start_bytes} has {size_bytes} bytes, not {body.size_bytes}."
        )
    part = UploadPart(start_bytes, body.sha256, size_bytes)
    async with service.evictor.upload_lease(size_bytes) as lease:
        writer = await run_in_pool(
            ThreadPurpose.UPLOADS, service.storage.open_writer,
            sha256=part.sha256, size_bytes=size_bytes, max_bytes=size_bytes,
        )  # fmt: skip
        await receive.receive_body(body.body, writer, service.settings.upload_limits())
        await _record_part(service, lease, upload, part)
    return await store_if_whole(service, upload)


@retry_on_deadlock
async def _record_part(service: Service, lease: StorageLease, upload: FileUpload, part: UploadPart) -> None:
    async with lease.reference({part.sha256}) as connection:
        await rows.put_part(connection, upload, part)
        await check_bytes(connection, upload.owner, service.settings.quota)
