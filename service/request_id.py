"""Ids of requests, which connect an answer with the lines of the log."""

import logging
import re
import uuid
from contextvars import ContextVar

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import Message, Receive, Scope, Send

from octasplat.service.http_middleware import HttpMiddleware

HEADER = "X-Request-ID"
_VALID = re.compile(r"[A-Za-z0-9._:/+=-]{1,100}")
_current: ContextVar[str | None] = ContextVar("request_id", default=None)


def current_request_id() -> str | None:
    """Return the id of the request that is being answered; None outside of one."""
    return _current.get()


class RequestIdMiddleware(HttpMiddleware):
    """Gives each request an id, that of its client or proxy where it sends one, and answers with it."""

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on with its id."""
        given = Headers(scope=scope).get(HEADER, "")
        request_id = given if _VALID.fullmatch(given) else uuid.uuid4().hex

        async def send_with_id(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message)[HEADER] = request_id
            await send(message)

        token = _current.set(request_id)
        try:
            await self._app(scope, receive, send_with_id)
        finally:
            _current.reset(token)


class RequestIdFilter(logging.Filter):
    """Puts the id of the request that is being answered behind each line of the log."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Let every record pass, with the id behind its message."""
        request_id = current_request_id()
        if request_id is not None:
            record.msg, record.args = f"{record.getMessage()} [request {request_id}]", None
        return True
