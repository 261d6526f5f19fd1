"""Routes of the API, one module a subject."""

from typing import Any

from octasplat.service.problems import MEDIA_TYPE, ProblemDocument
from octasplat.service.routes.response_headers import CONTENT_RANGE, RETRY_AFTER, WWW_AUTHENTICATE


def problem_responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI descriptions of these error statuses; 400, 401, 429 and 503 are everywhere."""
    content = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/ProblemDocument"}}}
    names = {
        400: "Malformed", 401: "No valid token", 403: "The token's scope does not suffice",
        404: "There is no such thing, or it is not yours", 408: "The upload stalled",
        409: "Its state does not allow that", 410: "The content is gone", 412: "It has changed",
        413: "Too long", 415: "Another media type is needed",
        416: "No such range", 421: "A foreign host name", 422: "Refused; see errors",
        429: "Too many requests, or wrong tokens", 503: "Try again later", 507: "No room",
    }  # fmt: skip
    headers = {
        401: WWW_AUTHENTICATE,
        416: CONTENT_RANGE,
        429: RETRY_AFTER,
        503: RETRY_AFTER,
        507: RETRY_AFTER,
    }
    return {
        status: {
            "description": names[status],
            "content": content,
            "model": None,
            **({"headers": dict(headers[status])} if status in headers else {}),
        }
        for status in sorted({400, 401, 403, 421, 422, 429, 503, *statuses})
    }


__all__ = ["ProblemDocument", "problem_responses"]
