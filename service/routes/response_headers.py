"""Headers of answers, as the OpenAPI document declares them."""

from collections.abc import Mapping
from typing import Any

Header = Mapping[str, Any]


def header(name: str, description: str, kind: str = "string") -> Header:
    """Return the OpenAPI description of a header."""
    return {name: {"description": description, "schema": {"type": kind}}}


LOCATION = header("Location", "Address of what was made.")
RETRY_AFTER = header("Retry-After", "Seconds after which another look, or try, is worth while.", "integer")
ETAG = header("ETag", "Changes with the content; for `If-None-Match` and `If-Match`.")
RATE_LIMIT = (
    header("RateLimit-Policy", 'Your quota, such as `"jobs";q=20`; absent without one.'),
    header("RateLimit", 'What is left of your quota, such as `"jobs";r=3`; absent without one.'),
)
LINK = header("Link", 'The next part of the list, as `<address>; rel="next"` (RFC 8288); absent at the end.')
CONTENT_RANGE = header("Content-Range", "Which bytes of how many.")
WWW_AUTHENTICATE = header("WWW-Authenticate", "How to show a token.")
DIGEST = header("Repr-Digest", "SHA-256 of the whole content (RFC 9530).")
DISPOSITION = header("Content-Disposition", "File name for whoever saves it.")
CONTENT = (ETAG, DIGEST, DISPOSITION, header("Accept-Ranges", "`bytes`."))


def with_headers(status: int, *headers: Header, **further: Any) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI description of an answer with these headers."""
    return {
        status: {"headers": {name: value for header in headers for name, value in header.items()}, **further}
    }


def not_modified() -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI description of the answer 304."""
    return with_headers(304, ETAG, description="Not changed")


def stored_content(*media_types: str) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI descriptions of stored content: complete, a part, or not changed.

    By default it is of any type; generators take the first that is named, which is bytes.
    """
    named = media_types or ("application/octet-stream", "*/*")
    content = {name: {"schema": {"type": "string", "format": "binary"}} for name in named}
    return {
        **with_headers(200, *CONTENT, description="The content", content=content),
        **with_headers(206, *CONTENT, CONTENT_RANGE, description="A part of the content", content=content),
        **not_modified(),
    }
