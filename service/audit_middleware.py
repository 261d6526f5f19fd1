"""Middleware that writes each requested change to the audit log before the response is sent."""

import logging
from typing import TYPE_CHECKING

import psycopg
from psycopg_pool import PoolTimeout
from starlette.datastructures import Headers
from starlette.types import Message, Receive, Scope, Send

from octasplat.service.http_middleware import HttpMiddleware
from octasplat.workers.db.audit import add_entry

if TYPE_CHECKING:
    from octasplat.service.state import Service

logger = logging.getLogger(__name__)

_UNAUDITED_METHODS = frozenset({"GET", "HEAD", "OPTIONS", "TRACE", "PUT"})
"""Reading, and the single files of datasets, whose commits are told."""


class AuditMiddleware(HttpMiddleware):
    """Records changes in the audit log, with the caller if known and the outcome."""

    async def handle(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, and send its response once it is recorded."""
        # request.state of the routes is this very dictionary.
        state = scope.setdefault("state", {})
        is_recorded = False

        async def record(status: int, headers: Headers) -> None:
            nonlocal is_recorded
            if is_recorded or (scope["method"] in _UNAUDITED_METHODS and not state.get("is_change")):
                return
            if state.get("principal") is None:  # or whoever comes could fill the table
                return
            is_recorded = True
            await _write_entry(scope, status, headers.get("location"))

        async def send_and_record(message: Message) -> None:
            if message["type"] == "http.response.start":
                await record(message["status"], Headers(raw=message["headers"]))
            await send(message)

        try:
            await self._app(scope, receive, send_and_record)
        except Exception:
            # The answer to it is made further out, and does not come by here.
            await record(500, Headers())
            raise


async def _write_entry(scope: Scope, status: int, location: str | None) -> None:
    service: Service = scope["app"].state.service
    principal = scope["state"]["principal"]
    try:
        async with service.pool.connection() as connection:
            await add_entry(
                connection,
                owner=principal.owner,
                token_id=principal.token_id,
                session_id=principal.session_id,
                address=scope["client"][0] if scope.get("client") else "unknown",
                action=f"{scope['method']} {scope['path']}",
                target=location,
                status=status,
            )
    except (psycopg.Error, PoolTimeout) as error:
        # The change is made, so that its answer goes out all the same.
        logger.warning("%s %s was not written down: %s", scope["method"], scope["path"], error)
