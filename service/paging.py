"""Pagination of long lists: an opaque cursor, and a link to the next part (RFC 8288)."""

import base64
import binascii
import uuid
from typing import Annotated

from fastapi import Query, Request, Response

from octasplat.service.problems import ProblemError

Limit = Annotated[int, Query(ge=1, le=200, description="Most entries of one answer.")]
LongLimit = Annotated[int, Query(ge=1, le=5000, description="Most entries of one answer.")]
Cursor = Annotated[str | None, Query(max_length=2000, description="`next` of the answer before.")]


def encode_cursor(key: str) -> str:
    """Return the cursor of a position in a list."""
    return base64.urlsafe_b64encode(key.encode()).decode().rstrip("=")


def decode_cursor(cursor: str | None) -> str | None:
    """Return the position of a cursor.

    Raises:
        ProblemError: 422 if it is none of ours.
    """
    if cursor is None:
        return None
    try:
        padded = cursor + "=" * (-len(cursor) % 4)  # encode_cursor leaves it out
        place = base64.b64decode(padded, altchars=b"-_", validate=True).decode()
        if "\0" in place:
            raise ValueError("no place has a NUL")
        return place
    except (binascii.Error, ValueError):
        raise ProblemError(422, "cursor", "The cursor is none that this service gave out.") from None


def decode_id_cursor(cursor: str | None) -> uuid.UUID | None:
    """Return the position of a cursor in a list ordered by id; see :func:`decode_cursor`."""
    place = decode_cursor(cursor)
    try:
        return None if place is None else uuid.UUID(place)
    except ValueError:
        raise ProblemError(422, "cursor", "The cursor is none that this service gave out.") from None


def decode_number_cursor(cursor: str | None) -> int | None:
    """Return the position of a cursor in a list ordered by a number; see :func:`decode_cursor`."""
    place = decode_cursor(cursor)
    if place is None:
        return None
    # More digits may be above the largest bigint of the database.
    if not (place.isascii() and place.isdigit() and len(place) < 19):
        raise ProblemError(422, "cursor", "The cursor is none that this service gave out.")
    return int(place)


def set_next_link(request: Request, response: Response, next_key: str | None) -> str | None:
    """Set the header ``Link`` and return the cursor of the next part; None at the end."""
    if next_key is None:
        return None
    cursor = encode_cursor(next_key)
    response.headers["Link"] = f'<{request.url.include_query_params(cursor=cursor)}>; rel="next"'
    return cursor
