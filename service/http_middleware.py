"""Base of the middleware of the service."""

import re
from abc import ABC, abstractmethod

from starlette.types import ASGIApp, Receive, Scope, Send

_UPLOAD_PATH = re.compile(r"/v1/datasets/[^/]+/uploads/[^/]+")


class HttpMiddleware(ABC):
    """Middleware for HTTP requests; messages of other protocols pass it as they are.

    Args:
        app: behind it.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request, or pass on what is none."""
        if scope["type"] == "http":
            await self.handle(scope, receive, send)
        else:
            await self._app(scope, receive, send)

    @abstractmethod
    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it on."""


def is_file_content(scope: Scope) -> bool:
    """Return whether the body of a request is content of a file, which only its route reads and counts."""
    is_part = scope["method"] == "PATCH" and _UPLOAD_PATH.fullmatch(scope["path"]) is not None
    return is_part or scope["method"] == "PUT"
