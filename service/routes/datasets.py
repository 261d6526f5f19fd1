"""Routes of datasets: created, filled file by file or by an archive, read, deleted."""

from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Header, Path, Request, Response
from starlette.requests import ClientDisconnect

from octasplat.service.actions import datasets as actions
from octasplat.service.actions import reused_files, uploads
from octasplat.service.actions.reused_files import WantedFile
from octasplat.service.actions.usage import rate_limit_headers
from octasplat.service.auth import Reader, Writer
from octasplat.service.downloads import send_blob
from octasplat.service.etags import check_precondition, set_etag, unless_unchanged
from octasplat.service.intake.receive import parse_digest
from octasplat.service.paging import Cursor, Limit, LongLimit, decode_cursor, decode_id_cursor, set_next_link
from octasplat.service.problems import ProblemError
from octasplat.service.routes import problem_responses
from octasplat.service.routes.parameters import (
    DatasetId,
    IdempotencyKey,
    IfMatch,
    IfNoneMatch,
    IfRange,
    Range,
)
from octasplat.service.routes.response_headers import (
    ETAG,
    LINK,
    LOCATION,
    RATE_LIMIT,
    not_modified,
    stored_content,
    with_headers,
)
from octasplat.service.schemas.datasets import (
    ArchiveView,
    DatasetChange,
    DatasetPage,
    DatasetView,
    FilePage,
    FilesToReuse,
    FileView,
    NewDataset,
    ReusedFilesView,
)
from octasplat.service.state import ServiceDep
from octasplat.workers.db.rows import Dataset
from octasplat.workers.worker.media_types import media_type

router = APIRouter(prefix="/v1/datasets", tags=["datasets"])

Digest = Annotated[
    str | None,
    Header(alias="Repr-Digest", max_length=1000, description="RFC 9530: `sha-256=:<base64>:`"),
]


def binary_body(*media_types: str) -> dict[str, Any]:
    """Return the OpenAPI description of a body of bytes."""
    schema = {"type": "string", "format": "binary"}
    content = {name: {"schema": schema} for name in media_types}
    return {"requestBody": {"content": content, "required": True}}


FilePath = Annotated[str, Path(max_length=1000, description="Such as images/0001.jpg.")]


@router.post(
    "", status_code=201, responses={**with_headers(201, LOCATION, *RATE_LIMIT), **problem_responses(404)}
)
async def create_dataset(
    new: NewDataset, principal: Writer, service: ServiceDep, response: Response, key: IdempotencyKey = None
) -> DatasetView:
    """Create a dataset for photographs, or for files that the options of jobs name."""
    dataset = await actions.create_dataset(service, principal, new, idempotency_key=key)
    response.headers["Location"] = f"/v1/datasets/{dataset.id}"
    response.headers.update(await rate_limit_headers(service, principal, "datasets"))
    return DatasetView.from_row(dataset)


@router.get("", responses={**with_headers(200, LINK), **problem_responses()})
async def list_datasets(
    principal: Reader, service: ServiceDep, request: Request, response: Response, limit: Limit = 50,
    cursor: Cursor = None,
) -> DatasetPage:  # fmt: skip
    """List your datasets, newest first."""
    part = await actions.list_datasets(service, principal, before=decode_id_cursor(cursor), limit=limit)
    following = set_next_link(request, response, part.next_key)
    return DatasetPage(datasets=[DatasetView.from_row(row) for row in part.rows], next=following)


@router.get(
    "/{dataset_id}", responses={**with_headers(200, ETAG), **not_modified(), **problem_responses(404)}
)
async def get_dataset(
    dataset_id: DatasetId, principal: Reader, service: ServiceDep, response: Response,
    if_none_match: IfNoneMatch = None,
) -> DatasetView:  # fmt: skip
    """Return one dataset."""
    dataset = await actions.get_dataset(service, principal, dataset_id)
    return unless_unchanged(response, if_none_match, _dataset_etag(dataset), DatasetView.from_row(dataset))


@router.patch("/{dataset_id}", responses={**with_headers(200, ETAG), **problem_responses(404, 412)})
async def change_dataset(
    dataset_id: DatasetId, change: DatasetChange, principal: Writer, service: ServiceDep, response: Response,
    if_match: IfMatch = None,
) -> DatasetView:  # fmt: skip
    """Rename a dataset, or pin it so that it does not expire."""

    def check(dataset: Dataset) -> None:
        check_precondition(if_match, _dataset_etag(dataset))

    dataset = await actions.change_dataset(service, principal, dataset_id, change, check)
    set_etag(response, _dataset_etag(dataset))
    return DatasetView.from_row(dataset)


@router.delete("/{dataset_id}", status_code=204, responses=problem_responses(404, 409))
async def delete_dataset(dataset_id: DatasetId, principal: Writer, service: ServiceDep) -> None:
    """Delete a dataset that no job needs."""
    await actions.delete_dataset(service, principal, dataset_id)


@router.get("/{dataset_id}/files", responses={**with_headers(200, LINK), **problem_responses(404)})
async def list_files(
    dataset_id: DatasetId, principal: Reader, service: ServiceDep, request: Request, response: Response,
    limit: LongLimit = 1000, cursor: Cursor = None,
) -> FilePage:  # fmt: skip
    """List the uploaded files by name; a resumed upload sends only the others."""
    after = decode_cursor(cursor) or ""
    part = await uploads.list_files(service, principal, dataset_id, after=after, limit=limit)
    following = set_next_link(request, response, part.next_key)
    return FilePage(files=[FileView.from_row(row) for row in part.rows], next=following)


@router.post("/{dataset_id}/files", responses=problem_responses(404, 409, 413))
async def reuse_files(
    dataset_id: DatasetId, wanted: FilesToReuse, principal: Writer, service: ServiceDep,
    _key: IdempotencyKey = None,
) -> ReusedFilesView:  # fmt: skip
    """Take over files by their digests, as far as the dataset's owner has stored them before; send the rest.

    The files are checked as if they had been sent, and stay when what they are taken from is deleted.
    """
    files = [WantedFile(file.path, file.sha256) for file in wanted.files]
    reused = await reused_files.reuse_files(service, principal, dataset_id, files)
    return ReusedFilesView(
        files=[FileView.from_row(row) for row in reused.files], missing=list(reused.missing)
    )


@router.put(
    "/{dataset_id}/files/{path:path}",
    status_code=201,
    responses={
        200: {"description": "It was there already", "model": FileView},
        **problem_responses(404, 408, 409, 413, 507),
    },
    openapi_extra=binary_body("application/octet-stream"),
)
async def put_file(
    dataset_id: DatasetId, path: FilePath, principal: Writer, service: ServiceDep, request: Request,
    response: Response, digest: Digest = None,
) -> FileView:  # fmt: skip
    """Send a file: the body is its content. A repeat with the same digest does nothing."""
    file = await uploads.put_file(service, principal, dataset_id, path, upload_of_request(request, digest))
    if file.is_unchanged:
        response.status_code = 200
    return FileView.from_row(file.row)


@router.get(
    "/{dataset_id}/files/{path:path}",
    responses={**stored_content(), **problem_responses(404, 410, 416)},
    response_class=Response,
)
@router.head(
    "/{dataset_id}/files/{path:path}", responses=problem_responses(404, 410, 416), include_in_schema=False
)
async def get_file(
    dataset_id: DatasetId, path: FilePath, principal: Reader, service: ServiceDep, request: Request,
    _range: Range = None, _if_range: IfRange = None, _if_none_match: IfNoneMatch = None,
) -> Response:  # fmt: skip
    """Return the content of a file; `Range` and `If-Range` let a download resume."""
    row = await uploads.get_file(service, principal, dataset_id, path)
    return await send_blob(
        service, request, row.sha256, row.size_bytes, media_type=media_type(row.path), name=row.path
    )


@router.delete("/{dataset_id}/files/{path:path}", status_code=204, responses=problem_responses(404, 409))
async def delete_file(dataset_id: DatasetId, path: FilePath, principal: Writer, service: ServiceDep) -> None:
    """Remove a file from an open dataset."""
    await uploads.remove_file(service, principal, dataset_id, path)


@router.put(
    "/{dataset_id}/archive",
    responses=problem_responses(404, 408, 409, 413, 507),
    openapi_extra=binary_body("application/octet-stream", "application/zip"),
)
async def put_archive(
    dataset_id: DatasetId, principal: Writer, service: ServiceDep, request: Request, digest: Digest = None
) -> ArchiveView:
    """Upload a scene as a ZIP file; its files are added to those that are there."""
    archive = await uploads.put_archive(service, principal, dataset_id, upload_of_request(request, digest))
    return _archive_view(archive)


def _archive_view(archive: uploads.StoredArchive) -> ArchiveView:
    return ArchiveView(
        files=[FileView.from_row(row) for row in archive.files],
        left_out=list(archive.left_out),
        notes=list(archive.notes),
    )


def _dataset_etag(dataset: Dataset) -> str:
    return f'"{dataset.version}"'


def upload_of_request(request: Request, digest: str | None) -> uploads.Upload:
    """Return what a request sends, as it announces it."""
    text = request.headers.get("content-length")
    length = int(text) if text is not None and text.isdigit() else None
    return uploads.Upload(request_body(request), sha256=parse_digest(digest), size_bytes=length)


async def request_body(request: Request) -> AsyncIterator[bytes]:
    """Yield the body of a request; one that breaks off leaves nothing."""
    try:
        async for piece in request.stream():
            yield piece
    except ClientDisconnect:
        raise ProblemError(400, "upload-broken", "The upload broke off; send the file again.") from None
