"""Datasets: made, filled file by file or by an archive, checked, read, deleted."""

import asyncio
import uuid
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Header, Path, Query, Request, Response
from starlette.requests import ClientDisconnect

from service.auth import Principal, Reader, Writer
from service.downloads import send_blob
from service.idempotency import IdempotencyKey, fingerprint, once
from service.intake.dataset import DatasetFile as IntakeFile
from service.intake.dataset import DatasetSummary, check_dataset, check_file_name
from service.intake.receive import parse_digest, receive_archive, receive_file
from service.paging import Cursor, Limit, link_next, read_cursor, read_id_cursor, write_cursor
from service.problems import Problem, not_found
from service.routes import problems
from service.schemas.datasets import (
    ArchiveView,
    DatasetChange,
    DatasetPage,
    DatasetView,
    FilePage,
    FileView,
    NewDataset,
)
from service.state import Service, ServiceDep
from workers.records import datasets as rows
from workers.records.database import Connection
from workers.records.errors import Conflict
from workers.records.quotas import QuotaExceeded, bytes_left, check_bytes, check_new_dataset
from workers.records.rows import Dataset, DatasetFile
from workers.store.errors import TooLarge
from workers.work.media_types import media_type

T = TypeVar("T")

router = APIRouter(prefix="/v1/datasets", tags=["datasets"])

Digest = Annotated[
    str | None,
    Header(alias="Repr-Digest", max_length=1000, description="RFC 9530: `sha-256=:<base64>:`"),
]
FilePath = Annotated[str, Path(max_length=1000, description="Such as images/0001.jpg.")]


@router.post("", status_code=201, responses=problems())
async def create_dataset(
    new: NewDataset, who: Writer, service: ServiceDep, response: Response, key: IdempotencyKey = None
) -> DatasetView:
    """Make a dataset to put photographs into."""
    async with service.pool.connection() as connection, connection.transaction():

        async def make() -> uuid.UUID:
            await check_new_dataset(connection, who.owner, service.settings.quota)
            return (await rows.create_dataset(connection, who.owner, new.name)).id

        request = fingerprint("dataset", new.model_dump())
        dataset_id, _ = await once(connection, who, key, request, make)
        dataset = await _owned(connection, who, dataset_id)
    response.headers["Location"] = f"/v1/datasets/{dataset_id}"
    return DatasetView.of(dataset)


@router.get("", responses=problems())
async def list_datasets(
    who: Reader, service: ServiceDep, request: Request, response: Response, limit: Limit = 50,
    cursor: Cursor = None,
) -> DatasetPage:  # fmt: skip
    """Your datasets, the newest first."""
    before = read_id_cursor(cursor)
    async with service.pool.connection() as connection:
        found = await rows.list_datasets(connection, owner=who.sees, before=before, limit=limit + 1)
    following = write_cursor(str(found[limit - 1].id)) if len(found) > limit else None
    link_next(request, response, following)
    return DatasetPage(datasets=[DatasetView.of(row) for row in found[:limit]], next=following)


@router.get("/{dataset_id}", responses=problems(404))
async def get_dataset(dataset_id: uuid.UUID, who: Reader, service: ServiceDep) -> DatasetView:
    """A dataset."""
    async with service.pool.connection() as connection:
        return DatasetView.of(await _owned(connection, who, dataset_id))


@router.patch("/{dataset_id}", responses=problems(404))
async def change_dataset(
    dataset_id: uuid.UUID, change: DatasetChange, who: Writer, service: ServiceDep
) -> DatasetView:
    """Rename a dataset, or keep it whatever its age."""
    async with service.pool.connection() as connection, connection.transaction():
        dataset = await _owned(connection, who, dataset_id, lock=True)
        changed = await rows.change_dataset(
            connection,
            dataset_id,
            name=dataset.name if change.name is None else change.name,
            pinned=dataset.pinned if change.pinned is None else change.pinned,
        )
    return DatasetView.of(changed)


@router.delete("/{dataset_id}", status_code=204, responses=problems(404, 409))
async def delete_dataset(dataset_id: uuid.UUID, who: Writer, service: ServiceDep) -> None:
    """Delete a dataset that no job needs."""
    async with service.pool.connection() as connection:
        await _owned(connection, who, dataset_id)
        await rows.delete_dataset(connection, dataset_id)
    service.room.after_deletion()


@router.get("/{dataset_id}/files", responses=problems(404))
async def list_files(
    dataset_id: uuid.UUID, who: Reader, service: ServiceDep, request: Request, response: Response,
    limit: Annotated[int, Query(ge=1, le=5000)] = 1000, cursor: Cursor = None,
) -> FilePage:  # fmt: skip
    """The files that have arrived, by name; whoever resumes an upload sends only the others."""
    after = read_cursor(cursor) or ""
    async with service.pool.connection() as connection:
        await _owned(connection, who, dataset_id)
        found = await rows.files_of(connection, dataset_id, after=after, limit=limit + 1)
    following = write_cursor(found[limit - 1].path) if len(found) > limit else None
    link_next(request, response, following)
    return FilePage(files=[FileView.of(row) for row in found[:limit]], next=following)


@router.put(
    "/{dataset_id}/files/{path:path}",
    status_code=201,
    responses={
        200: {"description": "It was there already", "model": FileView},
        **problems(404, 408, 409, 413, 507),
    },
    openapi_extra={"requestBody": {"content": {"application/octet-stream": {}}, "required": True}},
)
async def put_file(
    dataset_id: uuid.UUID, path: FilePath, who: Writer, service: ServiceDep, request: Request,
    response: Response, digest: Digest = None,
) -> FileView:  # fmt: skip
    """Send a file: the body is its content. A repeat with the same digest does nothing."""
    sha256 = parse_digest(digest)
    check_file_name(path)
    _refuse_while_draining(service)
    async with service.pool.connection() as connection:
        dataset = await _open(connection, who, dataset_id)
        known = await rows.get_file(connection, dataset_id, path)
        left = await bytes_left(connection, dataset.owner, service.settings.quota)
    if known is not None and sha256 == known.sha256:
        response.status_code = 200
        return FileView.of(known)
    if left is not None and known is not None:
        left += known.size_bytes  # it will be replaced
    async with service.room.upload(_length(request)) as note:
        received = await _received(
            lambda: receive_file(
                service.storage,
                path,
                request.stream(),
                sha256=sha256,
                size_bytes=_length(request),
                limits=service.settings.upload_limits(),
                max_bytes=left,
            ),
            left,
        )
        service.metrics.upload_bytes.inc(received.blob.size_bytes)
        async with service.pool.connection() as connection, connection.transaction():
            blob, facts = received.blob, received.facts
            await note.confirm(connection)
            row = await rows.put_file(connection, dataset_id, path, blob.sha256, blob.size_bytes, facts)
            await check_bytes(connection, dataset.owner, service.settings.quota)
    return FileView.of(row)


@router.get("/{dataset_id}/files/{path:path}", responses=problems(404, 410, 416), response_class=Response)
@router.head("/{dataset_id}/files/{path:path}", responses=problems(404, 410, 416), include_in_schema=False)
async def get_file(
    dataset_id: uuid.UUID, path: FilePath, who: Reader, service: ServiceDep, request: Request
) -> Response:
    """The content of a file."""
    row = await _file(service, who, dataset_id, path)
    return await asyncio.to_thread(
        lambda: send_blob(
            service,
            request,
            sha256=row.sha256,
            size_bytes=row.size_bytes,
            media_type=media_type(row.path),
            name=row.path,
        )
    )


@router.delete("/{dataset_id}/files/{path:path}", status_code=204, responses=problems(404, 409))
async def delete_file(dataset_id: uuid.UUID, path: FilePath, who: Writer, service: ServiceDep) -> None:
    """Take a file out of an open dataset."""
    async with service.pool.connection() as connection:
        await _open(connection, who, dataset_id)
        if "\0" in path or not await rows.remove_file(connection, dataset_id, path):
            raise not_found("file")
    service.room.after_deletion()


@router.put(
    "/{dataset_id}/archive",
    responses=problems(404, 408, 409, 413, 507),
    openapi_extra={"requestBody": {"content": {"application/zip": {}}, "required": True}},
)
async def put_archive(
    dataset_id: uuid.UUID, who: Writer, service: ServiceDep, request: Request, digest: Digest = None
) -> ArchiveView:
    """Send a whole scene as a ZIP file; its files join those that are there."""
    sha256 = parse_digest(digest)
    _refuse_while_draining(service)
    async with service.pool.connection() as connection:
        dataset = await _open(connection, who, dataset_id)
        left = await bytes_left(connection, dataset.owner, service.settings.quota)
    async with service.room.upload(_length(request)) as note:
        received = await _received(
            lambda: receive_archive(
                service.storage,
                request.stream(),
                service.settings.work_folder / "archives",
                sha256=sha256,
                size_bytes=_length(request),
                limits=service.settings.upload_limits(),
                max_bytes=left,
            ),
            left,
        )
        service.metrics.upload_bytes.inc(sum(file.blob.size_bytes for file in received.files))
        async with service.pool.connection() as connection, connection.transaction():
            await note.confirm(connection)
            files = [
                await rows.put_file(connection, dataset_id, f.path, f.blob.sha256, f.blob.size_bytes, f.facts)
                for f in received.files
            ]
            await check_bytes(connection, dataset.owner, service.settings.quota)
    return ArchiveView(files=[FileView.of(row) for row in files], left_out=list(received.left_out))


@router.post("/{dataset_id}/commit", responses=problems(404, 409))
async def commit(dataset_id: uuid.UUID, who: Writer, service: ServiceDep) -> DatasetView:
    """Check the dataset; if it is sound it never changes again and jobs can use it, else see `errors`."""
    async with service.pool.connection() as connection:
        await _owned(connection, who, dataset_id)
        before = await rows.begin_check(connection, dataset_id)
        if before.state == "committed":
            return DatasetView.of(before)
        files = await rows.files_of(connection, dataset_id)
    summary: DatasetSummary | None = None
    try:
        summary = await asyncio.to_thread(check_dataset, service.storage, [_for_intake(f) for f in files])
    finally:
        # Whatever happens, the dataset must not stay closed.
        dataset = await asyncio.shield(_end_check(service, dataset_id, summary))
    return DatasetView.of(dataset)


async def _end_check(service: Service, dataset_id: uuid.UUID, summary: DatasetSummary | None) -> Dataset:
    async with service.pool.connection() as connection:
        if summary is None:
            return await rows.end_check(connection, dataset_id, sound=False)
        facts: dict[str, Any] = asdict(summary)
        photographs, has_poses = facts.pop("photographs"), facts.pop("has_model")
        return await rows.end_check(
            connection, dataset_id, sound=True, has_poses=has_poses, photographs=photographs, facts=facts
        )


async def _received(take: Callable[[], Awaitable[T]], left: int | None) -> T:
    """What an upload brings; one that breaks off is nobody's fault and leaves nothing.

    ``left`` is what its owner may store, which is why it is too large if it is above that.
    """
    try:
        return await take()
    except TooLarge as error:
        if left is None or error.max_bytes != left:
            raise
        raise QuotaExceeded(
            "bytes", f"{left} bytes are left of what you may store; delete datasets or jobs first."
        ) from None
    except ClientDisconnect:
        raise Problem(400, "upload-broken", "The upload broke off; send the file again.") from None


async def _owned(
    connection: Connection, who: Principal, dataset_id: uuid.UUID, *, lock: bool = False
) -> Dataset:
    dataset = await rows.get_dataset(connection, dataset_id, lock=lock)
    if dataset is None or not who.owns(dataset.owner):
        raise not_found("dataset")
    return dataset


async def _open(connection: Connection, who: Principal, dataset_id: uuid.UUID) -> Dataset:
    dataset = await _owned(connection, who, dataset_id)
    if dataset.state != "open":
        raise Conflict(f"The dataset is {dataset.state}, so its files do not change; make a new dataset.")
    return dataset


async def _file(service: Service, who: Principal, dataset_id: uuid.UUID, path: str) -> DatasetFile:
    async with service.pool.connection() as connection:
        await _owned(connection, who, dataset_id)
        row = await rows.get_file(connection, dataset_id, path) if "\0" not in path else None
    if row is None:
        raise not_found("file")
    return row


def _for_intake(row: DatasetFile) -> IntakeFile:
    return IntakeFile(
        row.path,
        row.sha256,
        row.size_bytes,
        row.facts.get("width_px"),
        row.facts.get("height_px"),
        row.facts.get("warning"),
    )


def _length(request: Request) -> int | None:
    text = request.headers.get("content-length")
    return int(text) if text is not None and text.isdigit() else None


def _refuse_while_draining(service: Service) -> None:
    if service.draining:
        raise Problem(503, "draining", "The service is about to stop.", headers={"Retry-After": "10"})
