"""ETags for cheap polling and against lost updates."""

from fastapi import Request

from octasplat.service.problems import ProblemError


def etag_matches(header: str | None, etag: str) -> bool:
    """Return whether ``If-Match`` or ``If-None-Match`` names ``etag``; weak marks are ignored."""
    if header is None:
        return False
    named = [part.strip().removeprefix("W/") for part in header.split(",")]
    return "*" in named or etag in named


def check_precondition(request: Request, etag: str) -> None:
    """Refuse a change of an object that has changed since the caller read it.

    Raises:
        ProblemError: 412.
    """
    header = request.headers.get("if-match")
    if header is not None and not etag_matches(header, etag):
        raise ProblemError(412, "precondition", "It has changed since; look at it again.")
