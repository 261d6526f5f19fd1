"""Responses with stored content: complete or in ranges, with ETag and digest."""

import re
import urllib.parse
from pathlib import PurePosixPath

from fastapi import Request, Response
from fastapi.responses import FileResponse, StreamingResponse

from octasplat.service.etags import etag_matches
from octasplat.service.intake.receive import format_digest
from octasplat.service.problems import ProblemError
from octasplat.service.state import Service
from octasplat.service.thread_pools import ThreadPurpose, run_in_pool

_RANGE = re.compile(r"bytes=([0-9]{0,18})-([0-9]{0,18})")
_INLINE_TYPES = ("image/png", "image/jpeg", "application/json", "text/plain", "model/gltf-binary")
_SANDBOX_POLICY = (
    "sandbox; default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline'; script-src 'none'"
)


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
        ProblemError: 416 for a range that is not there.
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


def _stored_response(
    service: Service, request: Request, sha256: str, size: int, media_type: str, headers: dict[str, str]
) -> Response:
    """Return a response with a local file, or from a remote storage, complete or one range."""
    path = service.storage.local_path(sha256)
    if path is not None:
        return FileResponse(path, media_type=media_type, headers=headers)
    start, stop, status = 0, size, 200
    requested = _RANGE.fullmatch(request.headers.get("range", ""))
    condition = request.headers.get("if-range")
    if requested and any(requested.groups()) and (condition is None or condition == headers["ETag"]):
        first, last = requested.groups()
        if first:
            start, stop = int(first), min(size, int(last) + 1) if last else size
        else:
            start = max(0, size - int(last))
        if start >= stop:
            raise ProblemError(
                416, "range", "There is no such range.", headers={"Content-Range": f"bytes */{size}"}
            )
        status = 206
        headers["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
    headers["Content-Length"] = str(stop - start)
    if request.method == "HEAD":
        return Response(status_code=status, headers=headers, media_type=media_type)
    pieces = service.storage.read(sha256, start, stop)
    return StreamingResponse(pieces, status_code=status, headers=headers, media_type=media_type)


def _content_disposition(name: str, inline: bool) -> str:
    """Return the Content-Disposition header (RFC 6266)."""
    last = PurePosixPath(name).name
    plain = re.sub(r"[^A-Za-z0-9._ -]", "_", last)
    kind = "inline" if inline else "attachment"
    if plain == last:
        return f'{kind}; filename="{plain}"'
    return f"{kind}; filename=\"{plain}\"; filename*=UTF-8''{urllib.parse.quote(last, safe='')}"
