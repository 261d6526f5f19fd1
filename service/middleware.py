"""Middleware that refuses requests early: two lengths, foreign hosts, foreign pages, too long bodies."""

import re
from collections.abc import Mapping
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.middleware.body_limit import RequestBodyLimitMiddleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from octasplat.service.http_middleware import HttpMiddleware, is_file_content
from octasplat.service.problems import ProblemError

_LOCAL_HOSTS = frozenset({"localhost", "127.0.0.1", "::1"})
_SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS", "TRACE"})


class AllowedHostsMiddleware(HttpMiddleware):
    """Accepts requests for this machine's own names only, against DNS rebinding.

    Args:
        app: behind it.
        names: further names, without a port.
    """

    def __init__(self, app: ASGIApp, names: tuple[str, ...] = ()) -> None:
        super().__init__(app)
        self._names = _LOCAL_HOSTS | {name.lower() for name in names}

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer 421."""
        if _host_name(Headers(scope=scope).get("host", "")) not in self._names:
            detail = (
                "This service answers to localhost and 127.0.0.1 only; OCTASPLAT_ALLOWED_HOSTS adds more."
            )
            await ProblemError(421, "host", detail).response()(scope, receive, send)
            return
        await self._app(scope, receive, send)


class MessageFramingMiddleware(HttpMiddleware):
    """Refuses requests whose length is given in two ways, which servers on the way may read differently."""

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer 400 and close the connection (RFC 9112, section 6.1)."""
        headers = Headers(scope=scope)
        if "content-length" in headers and "transfer-encoding" in headers:
            detail = "The request has both Content-Length and Transfer-Encoding; send one of them."
            problem = ProblemError(400, "framing", detail, headers={"Connection": "close"})
            await problem.response()(scope, receive, send)
            return
        await self._app(scope, receive, send)


class SameOriginMiddleware(HttpMiddleware):
    """Refuses changes that a page of another site sends through a browser."""

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer 403."""
        if scope["method"] not in _SAFE_METHODS and _is_cross_site(Headers(scope=scope)):
            detail = "This request comes from a page of another site."
            await ProblemError(403, "origin", detail).response()(scope, receive, send)
            return
        await self._app(scope, receive, send)


class BodyLimitMiddleware:
    """Limits the length of every body but those of uploads, which are counted where they are written.

    Args:
        app: what comes next.
        max_body_bytes: length of a body.
        longer: other lengths, by what their addresses begin with.
    """

    def __init__(self, app: ASGIApp, max_body_bytes: int, longer: Mapping[str, int]) -> None:
        self._app = app
        self._limited = RequestBodyLimitMiddleware(app, max_body_size=max_body_bytes)
        self._longer = {
            prefix: RequestBodyLimitMiddleware(app, max_body_size=max(most, max_body_bytes))
            for prefix, most in longer.items()
        }

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on with its limit."""
        if scope["type"] != "http" or is_file_content(scope):
            await self._app(scope, receive, send)
            return
        replaced = False

        async def send_as_problem(message: Message) -> None:
            nonlocal replaced
            is_start = message["type"] == "http.response.start"
            # The library answers in plain text.
            if is_start and message["status"] == 413 and _PLAIN_TEXT_HEADER in message["headers"]:
                replaced = True
                await ProblemError(413, "too-large", "The request is too long.").response()(
                    scope, receive, send
                )
            elif not replaced:
                await send(message)

        limited = (app for prefix, app in self._longer.items() if scope["path"].startswith(prefix))
        await next(limited, self._limited)(scope, receive, send_as_problem)


class CompressionMiddleware:
    """Compresses what is made for an answer.

    Stored content is sent as it is, as its digests and ranges are of its own bytes.

    Args:
        app: behind it.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._compressed = GZipMiddleware(app, minimum_size=1000, compresslevel=5)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and compress the response if the client can read that."""
        is_stored = scope["type"] == "http" and _STORED_CONTENT.fullmatch(scope["path"])
        await (self._app if is_stored else self._compressed)(scope, receive, send)


class SecurityHeadersMiddleware(HttpMiddleware):
    """Adds headers that forbid browsers to sniff types, frame pages and store responses."""

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Add the headers to the response."""

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                given = {name.lower() for name, _ in message["headers"]}
                message["headers"] = [
                    *message["headers"],
                    *((name, value) for name, value in _SECURITY_HEADERS if name not in given),
                ]
            await send(message)

        await self._app(scope, receive, with_headers)


_STORED_CONTENT = re.compile(
    r"/v1/(jobs|datasets)/[^/]+/((artifacts|files)/.+|preview|live-scene|archive|events)|/jobs/[^/]+/report",
    re.DOTALL,
)
_PLAIN_TEXT_HEADER = (b"content-type", b"text/plain; charset=utf-8")
_SECURITY_HEADERS = (
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"SAMEORIGIN"),
    (b"referrer-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
)


def _is_cross_site(headers: Headers) -> bool:
    # A page of another port or subdomain is same-site, and still not one of ours.
    if headers.get("sec-fetch-site") in ("cross-site", "same-site"):
        return True
    origin = headers.get("origin")
    if origin is None:
        return False
    try:
        return urlsplit(origin).netloc.lower() != headers.get("host", "").lower()
    except ValueError:
        return True


def _host_name(host: str) -> str:
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""
