"""Byte ranges of requests (RFC 9110, section 14)."""

import re

from fastapi import Request

from octasplat.service.problems import ProblemError

MAX_RANGES = 20
"""A request for more is answered with the whole content."""
# As many digits as no length has, and still few to read.
_SPECIFIER = re.compile(r"([0-9]{1,100})-([0-9]{0,100})|-([0-9]{1,100})")


def requested_ranges(request: Request, etag: str, size_bytes: int) -> list[tuple[int, int]] | None:
    """Return the ranges that a request asks for, as (start, stop); None asks for the whole content.

    Units other than bytes are ignored, and so are all ranges where ``If-Range`` names another content, and
    those of a request for headers alone (RFC 9110, section 14.2).
    Specifiers that begin behind the end are left out as long as others do not.

    Args:
        request: with its headers ``Range`` and ``If-Range``.
        etag: of the content.
        size_bytes: length of the content.

    Raises:
        ProblemError: 400 for ranges that cannot be read, 416 if all of them begin behind the end.
    """
    header, condition = request.headers.get("range"), request.headers.get("if-range")
    if request.method != "GET" or header is None or (condition is not None and condition.strip() != etag):
        return None
    unit, equals, text = header.partition("=")
    if unit.strip().lower() != "bytes":
        return None
    specifiers = [part.strip() for part in text.split(",") if part.strip()]
    if len(specifiers) > MAX_RANGES:
        return None
    found = [_SPECIFIER.fullmatch(part) for part in specifiers]
    if not equals or not found or None in found:
        raise ProblemError(400, "range", "The header Range cannot be read; write it as bytes=0-499.")
    ranges: list[tuple[int, int]] = []
    for match in found:
        assert match is not None
        first, last, suffix = match.groups()
        if suffix is not None:
            start, stop = max(0, size_bytes - int(suffix)), size_bytes
        else:
            # A range names its last byte, and ``stop`` is the one behind it.
            start, stop = int(first), min(size_bytes, int(last) + 1) if last else size_bytes
            if last and int(last) < start:
                raise ProblemError(400, "range", "A range of the header Range ends before it begins.")
        if start < stop:
            ranges.append((start, stop))
    if not ranges:
        detail = f"The content has {size_bytes} bytes, so there is no such range."
        raise ProblemError(416, "range", detail, headers={"Content-Range": f"bytes */{size_bytes}"})
    return ranges
