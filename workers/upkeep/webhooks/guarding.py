"""A transport that looks a host up itself, and connects to nothing but what that gave and was found fit."""

import asyncio
import socket

import httpx

from octasplat.workers.upkeep.webhooks.addresses import (
    AddressRefused,
    IPAddress,
    is_allowed,
    is_public,
    read_address,
)


class GuardedTransport(httpx.AsyncBaseTransport):
    """Sends requests to addresses of the public network only, and to what ``allowed_hosts`` names.

    A host is looked up once for each request, all its addresses are judged before anything is opened, and the
    connection is made to one of these very addresses, so that another answer a moment later changes nothing.
    The name is still what the certificate must be for and what the header ``Host`` says.

    Args:
        allowed_hosts: see :func:`octasplat.workers.upkeep.webhooks.addresses.check_url`.
        inner: what sends requests to numeric addresses.
    """

    def __init__(self, allowed_hosts: tuple[str, ...], inner: httpx.AsyncBaseTransport) -> None:
        self._allowed_hosts = allowed_hosts
        self._inner = inner

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        """Send a request.

        Raises:
            AddressRefused: the host leads, or may lead, into a network that messages are not sent to.
            httpx.ConnectError: it has no address, or none that answers.
        """
        host = request.url.raw_host.decode("ascii")
        port = request.url.port or (443 if request.url.scheme == "https" else 80)
        addresses = await self._judged(host, port)
        for left, address in enumerate(addresses, start=1 - len(addresses)):
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

    async def _judged(self, host: str, port: int) -> list[IPAddress]:
        """The addresses of a host, all of them fit to connect to."""
        try:
            found = await asyncio.get_running_loop().getaddrinfo(host, port, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            raise httpx.ConnectError("The host has no address.") from error
        addresses = list(dict.fromkeys(read_address(str(sockaddr[0])) for *_, sockaddr in found))
        if not is_allowed(host, self._allowed_hosts) and not all(map(is_public, addresses)):
            raise AddressRefused("The address leads into a network that messages are not sent to.")
        return addresses
