"""ETags for cheap polling and against lost updates."""

import hashlib
from typing import TypeVar

from fastapi import Response
from pydantic import BaseModel

from octasplat.service.problems import ProblemError

_ViewT = TypeVar("_ViewT", bound=BaseModel)


def etag_matches(header: str | None, etag: str) -> bool:
    """Return whether ``If-Match`` or ``If-None-Match`` names ``etag``; weak marks are ignored."""
    if header is None:
        return False
    named = [part.strip().removeprefix("W/") for part in header.split(",")]
    return "*" in named or etag in named


def check_precondition(if_match: str | None, etag: str) -> None:
    """Refuse a change of an object that has changed since the caller read it.

    Raises:
        ProblemError: 412.
    """
    if if_match is not None and not etag_matches(if_match, etag):
        raise ProblemError(412, "precondition", "It has changed since; look at it again.")


def view_etag(view: BaseModel) -> str:
    """Return the ETag of a view whose row has no version."""
    return f'"{hashlib.sha256(view.model_dump_json().encode()).hexdigest()[:32]}"'


def set_etag(response: Response, etag: str) -> None:
    """Set the ETag of an answer, which caches may keep but not use without asking."""
    response.headers.update({"ETag": etag, "Cache-Control": "no-cache"})


def unless_unchanged(response: Response, if_none_match: str | None, etag: str, view: _ViewT) -> _ViewT:
    """Return what answers a request for a view: the view with its ETag, or 304 if the caller knows it.

    Args:
        response: the answer that gets the headers.
        if_none_match: the ETag that the caller has.
        etag: of the view.
        view: what was asked for.
    """
    if not etag_matches(if_none_match, etag):
        set_etag(response, etag)
        return view
    unchanged = Response(status_code=304)
    set_etag(unchanged, etag)
    return unchanged  # type: ignore[return-value]
