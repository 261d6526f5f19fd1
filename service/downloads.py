"""Responses with stored content: complete or in ranges, with ETag and digest."""

import hashlib
import logging
import re
import urllib.parse
from collections.abc import Iterator, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path, PurePosixPath

from fastapi import Request, Response
from fastapi.responses import FileResponse, StreamingResponse
from starlette.types import Receive, Scope, Send

from octasplat.service.etags import etag_matches
from octasplat.service.intake.receive import format_digest
from octasplat.service.problems import ProblemError
from octasplat.service.ranges import requested_ranges
from octasplat.service.state import Service
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.service.zip_stream import ZipEntry, stream_zip
from octasplat.workers.db.rows import Artifact

_INLINE_TYPES = ("image/png", "image/jpeg", "application/json", "text/plain", "model/gltf-binary")
_SANDBOX_POLICY = (
    "sandbox; default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline'; script-src 'none'"
)
SMALL_BYTES = 4 << 20
"""Contents up to this length are read whole before anything is sent."""

logger = logging.getLogger(__name__)


async def send_blob(
    service: Service,
    request: Request,
    sha256: str,
    size_bytes: int,
    *,
    media_type: str,
    name: str,
    inline: bool = False,
) -> Response:
    """Return a response with stored content.

    Content never changes under its digest, which makes the ETag. What an address leads to may change, as
    results do by a retry, so that a browser asks each time whether it is still that. What came from users or
    out of a job is never shown as a page of this site: anything but pictures and data is a download, pages
    are sandboxed.

    Args:
        service: the service.
        request: the request, whose conditions and ranges are heard.
        sha256: the content.
        size_bytes: its length.
        media_type: what it is.
        name: file name for whoever saves it.
        inline: show rather than save.

    Raises:
        ProblemError: 500 for a content that is damaged, 400 or 416 for ranges that cannot be read or are not
            there.
        StorageError: the store does not have it.
    """
    etag = f'"{sha256}"'
    is_inline = inline or media_type in _INLINE_TYPES
    headers = {
        "ETag": etag,
        "Repr-Digest": format_digest(sha256),
        "Cache-Control": "private, no-cache",
        "Accept-Ranges": "bytes",
        "Content-Disposition": _content_disposition(name, is_inline),
    }
    if media_type == "text/html":
        headers["Content-Security-Policy"] = _SANDBOX_POLICY
    if etag_matches(request.headers.get("if-none-match"), etag):
        return Response(status_code=304, headers=headers)
    return await run_in_pool(
        ThreadPurpose.DOWNLOADS,
        _stored_response,
        service,
        request,
        sha256,
        size_bytes,
        media_type,
        headers,
    )


def send_bytes(request: Request, content: bytes, *, media_type: str, name: str) -> Response:
    """Return a response with a small content that is not in the store, always complete.

    Args:
        request: the request, whose condition is heard.
        content: all of it.
        media_type: what it is.
        name: file name for whoever saves it.
    """
    sha256 = hashlib.sha256(content).hexdigest()
    etag = f'"{sha256}"'
    headers = {
        "ETag": etag,
        "Repr-Digest": format_digest(sha256),
        "Cache-Control": "private, no-cache",
        "Content-Disposition": _content_disposition(name, media_type in _INLINE_TYPES),
    }
    if etag_matches(request.headers.get("if-none-match"), etag):
        return Response(status_code=304, headers=headers)
    return Response(content, headers=headers, media_type=media_type)


def send_archive(
    service: Service, artifacts: Sequence[Artifact], name: str, modified_at: datetime
) -> Response:
    """Return a response with all results as one ZIP file, which is made while it is sent.

    Args:
        service: the service.
        artifacts: the results.
        name: file name for whoever saves it.
        modified_at: the time of its entries.
    """

    def read(artifact: Artifact) -> Iterator[bytes]:
        pieces = service.storage.read(artifact.sha256, 0, artifact.size_bytes)
        return _verified(pieces, artifact.sha256)

    entries = [ZipEntry(row.name, row.size_bytes, partial(read, row)) for row in artifacts]
    headers = {
        "Content-Disposition": _content_disposition(name, inline=False),
        "Cache-Control": "private, no-cache",
    }
    return StreamingResponse(stream_zip(entries, modified_at), media_type="application/zip", headers=headers)


def _stored_response(
    service: Service, request: Request, sha256: str, size: int, media_type: str, headers: dict[str, str]
) -> Response:
    """Return a response with a local file, or from a remote storage, complete or one range.

    A small content is compared with its digest first, a large one while it is sent, the last of it being held
    back until then; of ranges of a large one only the length of the whole is compared.

    Raises:
        ProblemError: 500 for a content that is damaged, 400 or 416 for ranges.
    """
    ranges = requested_ranges(request, headers["ETag"], size)
    is_small = size <= SMALL_BYTES
    if service.storage.stat(sha256).size_bytes != size or (is_small and not _is_sound(service, sha256)):
        raise _damaged(sha256)
    path = service.storage.local_path(sha256)
    # A whole large content goes on below, where it is compared while it is sent.
    if path is not None and (is_small or ranges is not None or request.method == "HEAD"):
        return _StoredFileResponse(path, ranges, media_type, headers)
    start, stop, status = 0, size, 200
    # Several ranges of a remote content are answered with all of it, as RFC 9110 allows.
    if ranges is not None and len(ranges) == 1:
        start, stop = ranges[0]
        status = 206
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
    headers["Content-Length"] = str(stop - start)
    if request.method == "HEAD":
        return Response(status_code=status, headers=headers, media_type=media_type)
    pieces = service.storage.read(sha256, start, stop)
    if status == 200 and not is_small:
        pieces = _verified(pieces, sha256)
    return StreamingResponse(pieces, status_code=status, headers=headers, media_type=media_type)


def _is_sound(service: Service, sha256: str) -> bool:
    """Return whether a stored content is what its digest says."""
    digest = hashlib.sha256()
    for piece in service.storage.read(sha256):
        digest.update(piece)
    return digest.hexdigest() == sha256


def _verified(pieces: Iterator[bytes], sha256: str) -> Iterator[bytes]:
    """Yield a whole content; the last piece only once the digest is that of the content.

    Raises:
        ProblemError: it is damaged; as the answer has begun, the connection is closed before its end.
    """
    digest = hashlib.sha256()
    last = b""
    for piece in pieces:
        digest.update(piece)
        if last:
            yield last
        last = piece
    if digest.hexdigest() != sha256:
        raise _damaged(sha256)
    yield last


def _damaged(sha256: str) -> ProblemError:
    """Return the problem of a content that is damaged, and tell the log."""
    logger.error("the stored content %s is damaged; octasplat fsck --verify names what needs it", sha256)
    detail = "What is stored under this name is damaged; make it anew, or upload it again."
    return ProblemError(500, "damaged", detail)


class _StoredFileResponse(FileResponse):
    """A file, or those ranges of it that :func:`requested_ranges` has found in the request."""

    def __init__(
        self, path: Path, ranges: list[tuple[int, int]] | None, media_type: str, headers: dict[str, str]
    ) -> None:
        super().__init__(path, media_type=media_type, headers=headers)
        self._ranges = ranges

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        # FileResponse parses the header once more, so that it gets the ranges as they were read here.
        headers = [pair for pair in scope["headers"] if pair[0] not in (b"range", b"if-range")]
        if self._ranges is not None:
            text = ",".join(f"{start}-{stop - 1}" for start, stop in self._ranges)
            headers.append((b"range", f"bytes={text}".encode()))
        await super().__call__({**scope, "headers": headers}, receive, send)


def _content_disposition(name: str, inline: bool) -> str:
    """Return the Content-Disposition header (RFC 6266)."""
    last = PurePosixPath(name).name
    # For clients that do not know filename*.
    plain = re.sub(r"[^A-Za-z0-9._ -]", "_", last)
    kind = "inline" if inline else "attachment"
    if plain == last:
        return f'{kind}; filename="{plain}"'
    return f"{kind}; filename=\"{plain}\"; filename*=UTF-8''{urllib.parse.quote(last, safe='')}"
