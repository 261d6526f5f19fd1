"""HTTP transport that resolves hosts itself and connects only to addresses that it has checked."""

import asyncio
import socket
import threading
from collections import Counter
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import httpx

from octasplat.workers.maintenance.webhooks.addresses import (
    AddressRefusedError,
    IPAddress,
    is_allowed,
    is_public,
    parse_address,
)

MAX_LOOKUPS, MAX_LOOKUPS_PER_OWNER = 40, 5
OWNER_EXTENSION = "octasplat_owner"
"""Extension of a request that says for whose message a host is looked up."""
_LOOKUP_POOL = ThreadPoolExecutor(MAX_LOOKUPS, "look_up")
"""Threads of their own: a name server that does not answer holds one for half a minute, and nobody else."""


class GuardedTransport(httpx.AsyncBaseTransport):
    """Sends requests to addresses of the public network only, and to what ``allowed_hosts`` names.

    A host is looked up once for each request, all its addresses are judged before anything is opened, and the
    connection is made to one of these very addresses, so that another answer a moment later changes nothing.
    The name is still what the certificate must be for and what the header ``Host`` says.

    Args:
        allowed_hosts: see :func:`octasplat.workers.maintenance.webhooks.addresses.check_url`.
        inner: what sends requests to numeric addresses.
    """

    def __init__(self, allowed_hosts: tuple[str, ...], inner: httpx.AsyncBaseTransport) -> None:
        self._allowed_hosts = allowed_hosts
        self._inner = inner
        self._lookups: Counter[str] = Counter()
        self._lookups_lock = threading.Lock()

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        """Send a request.

        Raises:
            AddressRefusedError: the host leads, or may lead, into a network that messages are not sent to.
            httpx.ConnectError: it has no address, or none that answers.
        """
        host = request.url.raw_host.decode("ascii")
        port = request.url.port or (443 if request.url.scheme == "https" else 80)
        addresses = await self._resolve_checked(host, port, str(request.extensions.get(OWNER_EXTENSION, "")))
        for left, address in enumerate(addresses, start=1 - len(addresses)):  # 0 is the last one
            numeric = httpx.Request(
                request.method,
                request.url.copy_with(host=str(address)),
                headers=request.headers,
                stream=request.stream,
                extensions={**request.extensions, "sni_hostname": host.rstrip(".")},
            )
            try:
                return await self._inner.handle_async_request(numeric)
            except (httpx.ConnectError, httpx.ConnectTimeout):
                if left == 0:
                    raise
        raise httpx.ConnectError("The host has no address.", request=request)

    async def aclose(self) -> None:
        """Close the connections."""
        await self._inner.aclose()

    async def _resolve_checked(self, host: str, port: int, owner: str) -> list[IPAddress]:
        """Return the addresses of a host, all of them allowed."""
        try:
            found = await asyncio.wrap_future(self._look_up(host, port, owner))
        except (OSError, UnicodeError) as error:
            raise httpx.ConnectError("The host has no address.") from error
        # Several entries of a lookup may have the same address.
        addresses = list(dict.fromkeys(parse_address(str(sockaddr[0])) for *_, sockaddr in found))
        if not is_allowed(host, self._allowed_hosts) and not all(map(is_public, addresses)):
            raise AddressRefusedError("The address leads into a network that messages are not sent to.")
        return addresses

    def _look_up(self, host: str, port: int, owner: str) -> "Future[list[Any]]":
        """Resolve a host in a thread, which counts until it ends, even if nobody waits for it any more."""
        with self._lookups_lock:
            if self._lookups[owner] >= MAX_LOOKUPS_PER_OWNER:
                # Taken for a failed lookup by the caller, so that the message is sent again later.
                raise OSError("Too many hosts of one owner are being looked up.")
            self._lookups[owner] += 1

        def ended(_future: object) -> None:
            with self._lookups_lock:
                self._lookups[owner] -= 1
                if not self._lookups[owner]:
                    del self._lookups[owner]

        future: Future[list[Any]] = _LOOKUP_POOL.submit(
            socket.getaddrinfo, host, port, type=socket.SOCK_STREAM
        )
        future.add_done_callback(ended)
        return future
