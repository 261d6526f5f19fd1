"""Routes of uploads of one large file each that go on after a break, as tus 1.0.0 has them.

Of its extensions: creation, expiration and termination. Beside it, parts may come in any order.
"""

import base64
import binascii
import re
import uuid
from email.utils import format_datetime
from typing import Annotated

from fastapi import APIRouter, Header, Path, Request, Response

from octasplat.service.actions import resumable_uploads as actions
from octasplat.service.actions import upload_parts
from octasplat.service.actions.resumable_uploads import NewUpload
from octasplat.service.actions.upload_parts import parts_ahead
from octasplat.service.auth import Reader, Writer
from octasplat.service.problems import ProblemError
from octasplat.service.routes import problem_responses
from octasplat.service.routes.datasets import Digest, binary_body, request_body, upload_of_request
from octasplat.service.routes.parameters import DatasetId, IdempotencyKey
from octasplat.service.routes.response_headers import LOCATION, header, with_headers
from octasplat.service.schemas.resumable_uploads import UploadView
from octasplat.service.state import ServiceDep
from octasplat.workers.db.uploads import FileUpload

router = APIRouter(prefix="/v1/datasets", tags=["datasets"])

VERSION = "1.0.0"
PART_MEDIA_TYPES = ("application/octet-stream", "application/offset+octet-stream")
"""Clients of tus send the second; generated ones know the first."""
UploadId = Annotated[uuid.UUID, Path(description="Id of the upload.")]
TusVersion = Annotated[
    str | None, Header(alias="Tus-Resumable", max_length=20, description=f"Version of tus: {VERSION}.")
]
_SHA256 = re.compile("[0-9a-f]{64}")
_OFFSET = header("Upload-Offset", "How much of the file has come.", "integer")
_LENGTH = header("Upload-Length", "Length of the file.", "integer")
_EXPIRES = header("Upload-Expires", "When the upload is given up unless more comes.")
_TUS = header("Tus-Resumable", "Version of tus.")


@router.post(
    "/{dataset_id}/uploads",
    status_code=201,
    responses={
        **with_headers(201, LOCATION, _OFFSET, _LENGTH, _EXPIRES, _TUS),
        **problem_responses(404, 409, 412, 413),
    },
)
async def create_upload(
    dataset_id: DatasetId, principal: Writer, service: ServiceDep, response: Response,
    length: Annotated[
        int, Header(alias="Upload-Length", ge=1, lt=1 << 62, description="Length of the file.")
    ],
    metadata: Annotated[
        str,
        Header(
            alias="Upload-Metadata",
            max_length=4000,
            description="As tus has it: `path` and the name of the file in the dataset in Base64, which a "
            "ZIP file does not have; `sha256` and the digest, hexadecimal, in Base64; parted by commas.",
        ),
    ] = "",
    version: TusVersion = None,
    key: IdempotencyKey = None,
) -> UploadView:  # fmt: skip
    """Begin to send one large file in parts, with tus 1.0.0; `PATCH` its `Location`.

    The same `Idempotency-Key` finds the upload again. For files of some megabytes `PUT .../files` is simpler.
    """
    _check_version(version)
    fields = _parse_metadata(metadata)
    new = NewUpload(length, fields.get("path"), _digest(fields.get("sha256")), metadata)
    upload = await actions.create_upload(service, principal, dataset_id, new, idempotency_key=key)
    response.headers.update(_headers(upload))
    response.headers["Location"] = f"/v1/datasets/{dataset_id}/uploads/{upload.id}"
    return UploadView.from_row(upload, await parts_ahead(service, upload))


@router.get(
    "/{dataset_id}/uploads/{upload_id}",
    responses={**with_headers(200, _OFFSET, _LENGTH, _EXPIRES, _TUS), **problem_responses(404, 412)},
)
@router.head(
    "/{dataset_id}/uploads/{upload_id}", responses=problem_responses(404, 412), include_in_schema=False
)
async def get_upload(
    dataset_id: DatasetId, upload_id: UploadId, principal: Reader, service: ServiceDep, response: Response,
    version: TusVersion = None,
) -> UploadView:  # fmt: skip
    """Return how much of an upload has come, as `HEAD` does; it is gone once its file is stored."""
    _check_version(version)
    upload = await actions.get_upload(service, principal, dataset_id, upload_id)
    response.headers.update(_headers(upload))
    # tus asks for this, as an offset that a cache remembers is out of date.
    response.headers["Cache-Control"] = "no-store"
    return UploadView.from_row(upload, await parts_ahead(service, upload))


@router.patch(
    "/{dataset_id}/uploads/{upload_id}",
    status_code=204,
    responses={
        **with_headers(204, LOCATION, _OFFSET, _EXPIRES, _TUS, description="It is kept"),
        **problem_responses(404, 408, 409, 412, 413, 415, 507),
    },
    openapi_extra=binary_body(*PART_MEDIA_TYPES),
)
async def continue_upload(
    dataset_id: DatasetId, upload_id: UploadId, principal: Writer, service: ServiceDep, request: Request,
    offset: Annotated[
        int, Header(alias="Upload-Offset", ge=0, lt=1 << 62, description="How much has come before.")
    ],
    version: TusVersion = None,
) -> Response:  # fmt: skip
    """Send more of an upload, behind what has come; what comes is kept also where the connection breaks.

    With the last byte `Location` names the task that stores the file in the dataset.
    """
    _check_version(version)
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() not in PART_MEDIA_TYPES:
        raise ProblemError(415, "media-type", f"Send parts of an upload as {PART_MEDIA_TYPES[1]}.")
    upload = await actions.continue_upload(
        service, principal, dataset_id, upload_id, offset_bytes=offset, body=request_body(request)
    )
    return _progress_response(upload)


@router.put(
    "/{dataset_id}/uploads/{upload_id}/parts/{start_bytes}",
    status_code=204,
    responses={
        **with_headers(204, LOCATION, _OFFSET, _EXPIRES, _TUS, description="It is kept"),
        **problem_responses(404, 408, 409, 413, 507),
    },
    openapi_extra=binary_body("application/octet-stream"),
)
async def put_part(
    dataset_id: DatasetId, upload_id: UploadId,
    start_bytes: Annotated[int, Path(ge=0, lt=1 << 62, description="Where it begins in the file.")],
    principal: Writer, service: ServiceDep, request: Request, digest: Digest = None,
) -> Response:  # fmt: skip
    """Send a part of an upload with its digest, in any order and over several connections at once.

    Parts begin at multiples of `part_bytes` of the upload, whose digest is announced, and are as long; the
    last one ends with the file. A repetition does nothing. With the last one that is lacking `Location`
    names the task that stores the file in the dataset.
    """
    upload = await upload_parts.put_part(
        service, principal, dataset_id, upload_id,
        start_bytes=start_bytes, body=upload_of_request(request, digest),
    )  # fmt: skip
    return _progress_response(upload)


@router.delete(
    "/{dataset_id}/uploads/{upload_id}", status_code=204, responses=problem_responses(404, 409, 412)
)
async def delete_upload(
    dataset_id: DatasetId, upload_id: UploadId, principal: Writer, service: ServiceDep,
    version: TusVersion = None,
) -> Response:  # fmt: skip
    """Give an upload up, with what has come of it."""
    _check_version(version)
    await actions.delete_upload(service, principal, dataset_id, upload_id)
    return Response(status_code=204, headers={"Tus-Resumable": VERSION})


def _progress_response(upload: FileUpload) -> Response:
    """Return the answer to what has come of an upload."""
    headers = _headers(upload)
    if upload.task_id is not None:
        headers["Location"] = f"/v1/datasets/{upload.dataset_id}/tasks/{upload.task_id}"
    return Response(status_code=204, headers=headers)


def _headers(upload: FileUpload) -> dict[str, str]:
    return {
        "Tus-Resumable": VERSION,
        "Upload-Offset": str(upload.offset_bytes),
        "Upload-Length": str(upload.size_bytes),
        "Upload-Expires": format_datetime(upload.expires_at, usegmt=True),
    }


def _check_version(version: str | None) -> None:
    """Refuse another version of tus.

    Raises:
        ProblemError: 412.
    """
    # Clients that are generated from the document leave the header out.
    if version is not None and version != VERSION:
        detail = f"Uploads are those of tus {VERSION}."
        raise ProblemError(412, "tus-version", detail, headers={"Tus-Version": VERSION})


def _parse_metadata(text: str) -> dict[str, str]:
    """Return what a client says of a file.

    Raises:
        ProblemError: 422 if it is not as tus has it.
    """
    fields = {}
    for pair in filter(None, (pair.strip() for pair in text.split(","))):
        name, _, value = pair.partition(" ")
        try:
            fields[name] = base64.b64decode(value, validate=True).decode()
        except (binascii.Error, UnicodeDecodeError):
            detail = f"Upload-Metadata: {name[:100]} is no text in Base64."
            raise ProblemError(422, "upload-metadata", detail) from None
    return fields


def _digest(sha256: str | None) -> str | None:
    if sha256 is not None and _SHA256.fullmatch(sha256) is None:
        detail = "Upload-Metadata: sha256 is no SHA-256 in hexadecimal digits."
        raise ProblemError(422, "upload-metadata", detail)
    return sha256
