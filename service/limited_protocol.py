"""HTTP/1.1 on limited connections: how many there are, and how long each may keep the front end waiting.

A connection that waits for a request, the first one or a further one, can be closed in favour of a new one,
beginning with the one that has waited longest. So those who open many and send nothing keep nobody else out.
"""

import asyncio
import contextlib
import fcntl
import logging
import sys
import termios
import time
from collections import defaultdict
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from octasplat.service.client_addresses import client_group, parse_client_address
from octasplat.service.connection_limits import MIN_BODY_BYTES, ConnectionLimits
from octasplat.workers.logs import RepeatedMessages

logger = logging.getLogger(__name__)
logger.addFilter(RepeatedMessages())

_ACCEPT_FAILED = "socket.accept() out of system resource"
"""What asyncio calls the failure to accept a connection."""


class ConnectionTable:
    """The open connections, by client.

    Args:
        limits: of them.
    """

    def __init__(self, limits: ConnectionLimits) -> None:
        self._limits = limits
        self._by_client: defaultdict[str, dict[LimitedProtocol, None]] = defaultdict(dict)
        self._count = 0

    def add(self, connection: "LimitedProtocol") -> bool:
        """Add a connection, closing another where there are too many; False if there is no place for it."""
        of_client = self._by_client[client_group(connection.address)]
        if len(of_client) >= self._limits.max_per_address and not self._is_proxy(connection.address):
            if not _close_longest_waiting(of_client):
                return False
        elif self._count >= self._limits.max_connections:
            # Whoever has most of them loses one.
            ranked = sorted(self._by_client.values(), key=len, reverse=True)
            if not any(_close_longest_waiting(group) for group in ranked):
                return False
        of_client[connection] = None
        self._count += 1
        return True

    def discard(self, connection: "LimitedProtocol") -> None:
        """Remove a connection that is closed, or was not added."""
        of_client = self._by_client[client_group(connection.address)]
        if connection in of_client:
            del of_client[connection]
            self._count -= 1
        if not of_client:
            del self._by_client[client_group(connection.address)]

    def close_overdue(self) -> None:
        """Close the connections that have kept the front end waiting for too long."""
        for group in list(self._by_client.values()):
            for connection in list(group):
                connection.close_if_overdue(self._limits)

    def _is_proxy(self, address: str) -> bool:
        parsed = parse_client_address(address)
        return parsed is not None and any(parsed in network for network in self._limits.proxies)


class LimitedConfig(uvicorn.Config):
    """Configuration of a server whose connections are limited."""

    connections: ConnectionTable


class LimitedProtocol(H11Protocol):
    """HTTP/1.1 on a connection that is counted, and closed when it is overdue."""

    def __init__(
        self,
        config: LimitedConfig,
        server_state: ServerState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        super().__init__(config, server_state, app_state, _loop)
        self._table = config.connections
        self.address = ""
        self.waiting_since = time.monotonic()
        self._body_bytes = 0
        self._unsent_bytes: int | None = None

    @property
    def is_waiting_for_request(self) -> bool:
        """Return whether there is no request under way."""
        return self.conn.their_state is h11.IDLE and not self.transport.is_closing()

    @property
    def _has_partial_headers(self) -> bool:
        """Return whether the headers of a request have not come in full; uvicorn ends kept connections."""
        return self.is_waiting_for_request and self.timeout_keep_alive_task is None

    @property
    def _is_waiting_for_body(self) -> bool:
        """Return whether more of a body is awaited, and would be read."""
        return (
            self.conn.their_state is h11.SEND_BODY
            and not self.cycle.waiting_for_100_continue
            and not self.flow.read_paused
        )

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin a connection, or refuse it where there are too many that are all in use."""
        super().connection_made(transport)
        self.address = self.client[0] if self.client is not None else ""
        if not self._table.add(self):
            # Without the application, as the connection is refused before its request is read.
            transport.write(_answer("503 Service Unavailable", "Retry-After: 5\r\n"))
            transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """End a connection."""
        self._table.discard(self)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take bytes; those of headers do not extend the time that there is for them."""
        was_waiting = self._has_partial_headers
        super().data_received(data)
        if self._is_waiting_for_body and self._body_bytes + len(data) < MIN_BODY_BYTES:
            self._body_bytes += len(data)
        elif not (was_waiting and self.is_waiting_for_request):
            self._restart_clock()

    def close_if_overdue(self, limits: ConnectionLimits) -> None:
        """Close the connection if it has kept the front end waiting for too long."""
        seconds = time.monotonic() - self.waiting_since
        if self.flow.write_paused or self.transport.is_closing():
            self._close_if_not_reading(limits.reader_seconds)  # whatever else it owes
        elif self._has_partial_headers:
            if seconds > limits.header_seconds:
                self.transport.write(_answer("408 Request Timeout"))
                self.transport.close()
        elif self._is_waiting_for_body:
            if seconds > limits.body_seconds:
                self.transport.close()
        elif not self.is_waiting_for_request:
            # Time that the service itself takes for an answer is not the client's.
            self._restart_clock()

    def _close_if_not_reading(self, reader_seconds: float) -> None:
        """Close the connection of a client that takes nothing of an answer, or next to nothing.

        One that is closed otherwise stays until the client has taken what was written before.
        """
        unsent = self.transport.get_write_buffer_size() + _unacknowledged_bytes(self.transport)
        before = self._unsent_bytes
        # More than before: all of that was taken, and more was written since.
        if before is None or not before - MIN_BODY_BYTES < unsent <= before:
            self._restart_clock()
            self._unsent_bytes = unsent
        elif time.monotonic() - self.waiting_since > reader_seconds:
            self.transport.abort()

    def _restart_clock(self) -> None:
        self.waiting_since, self._body_bytes, self._unsent_bytes = time.monotonic(), 0, None


def _unacknowledged_bytes(transport: asyncio.Transport) -> int:
    """Return how much of what was written the system still holds; 0 where it does not say."""
    connection = transport.get_extra_info("socket")
    with contextlib.suppress(OSError):
        return int.from_bytes(fcntl.ioctl(connection.fileno(), termios.TIOCOUTQ, bytes(4)), sys.byteorder)
    return 0


def _close_longest_waiting(connections: dict[LimitedProtocol, None]) -> bool:
    """Close the connection that has waited longest for a request; False if all have one."""
    waiting = [each for each in connections if each.is_waiting_for_request]
    if not waiting:
        return False
    min(waiting, key=lambda each: each.waiting_since).transport.abort()
    return True


def _answer(status: str, headers: str = "") -> bytes:
    return f"HTTP/1.1 {status}\r\n{headers}Content-Length: 0\r\nConnection: close\r\n\r\n".encode("ascii")


def log_loop_error(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log an error of the event loop; in one line if a connection could not be accepted."""
    if context.get("message") == _ACCEPT_FAILED:
        logger.warning("no connection can be accepted: %s", context["exception"])
    else:
        loop.default_exception_handler(context)
