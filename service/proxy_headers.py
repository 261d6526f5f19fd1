"""Headers of proxies in front of the service; only those of trusted proxies are used."""

import ipaddress
import re
from collections.abc import Sequence
from typing import Literal

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from octasplat.service.client_addresses import parse_client_address

Network = ipaddress.IPv4Network | ipaddress.IPv6Network
HeaderStyle = Literal["x-forwarded", "forwarded"]
_PAIR = re.compile(r'\s*([A-Za-z]+)\s*=\s*("[^"]*"|[^\s";,]*)\s*')


class ProxyHeadersMiddleware:
    """Replaces the proxy's address, scheme and host by those that a trusted proxy reports.

    One kind of header is read: a proxy that sets the one kind passes on what a client says in the other.

    Args:
        app: behind it.
        proxies: addresses whose word is taken.
        style: ``x-forwarded`` reads ``X-Forwarded-For``, ``-Proto`` and ``-Host``; ``forwarded`` reads
            RFC 7239.
    """

    def __init__(self, app: ASGIApp, proxies: Sequence[Network], style: HeaderStyle) -> None:
        self._app = app
        self._proxies = tuple(proxies)
        self._dialect = style

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on as its client sent it."""
        if scope["type"] == "http" and scope.get("client") and self._is_trusted_address(scope["client"][0]):
            headers = Headers(scope=scope)
            hops = (
                _parse_x_forwarded(headers) if self._dialect == "x-forwarded" else _parse_forwarded(headers)
            )
            self._apply(scope, hops)
        await self._app(scope, receive, send)

    def _apply(self, scope: Scope, hops: list[dict[str, str]]) -> None:
        """Use the last hop that a trusted proxy wrote; earlier ones may be forged."""
        for hop in reversed(hops):
            if hop.get("proto") in ("http", "https"):
                scope["scheme"] = hop["proto"]
            if hop.get("host"):
                others = [(name, value) for name, value in scope["headers"] if name != b"host"]
                # ASGI has headers as bytes, and those of HTTP are Latin-1.
                scope["headers"] = [(b"host", hop["host"].encode("latin-1", "replace")), *others]
            address = _parse_host_address(hop.get("for", ""))
            if address is None:
                return
            scope["client"] = (address, 0)
            if not self._is_trusted_address(address):
                return

    def _is_trusted_address(self, text: str) -> bool:
        address = parse_client_address(text)
        return address is not None and any(address in network for network in self._proxies)


def _parse_x_forwarded(headers: Headers) -> list[dict[str, str]]:
    """Return the hops, the client's first; a scheme or host that is given once is the client's."""
    lists = {key: _header_values(headers, f"x-forwarded-{key}") for key in ("for", "proto", "host")}
    count = max(len(values) for values in lists.values())
    hops: list[dict[str, str]] = [{} for _ in range(count)]
    for key, values in lists.items():
        # Lists of different lengths are aligned at their ends, where the last proxy has written.
        for place, hop in enumerate(hops):
            if len(values) == 1 and key != "for":
                hop[key] = values[0]
            elif (index := place - (count - len(values))) >= 0:
                hop[key] = values[index]
    return hops


def _parse_forwarded(headers: Headers) -> list[dict[str, str]]:
    """Return the hops of ``Forwarded`` (RFC 7239), the client's first."""
    return [
        {key.lower(): value.strip('"') for key, value in _PAIR.findall(element)}
        for element in _header_values(headers, "forwarded")
    ]


def _header_values(headers: Headers, name: str) -> list[str]:
    return [part.strip() for value in headers.getlist(name) for part in value.split(",") if part.strip()]


def _parse_host_address(text: str) -> str | None:
    """Return the address in ``192.0.2.1``, ``192.0.2.1:4711``, ``2001:db8::1`` or ``[2001:db8::1]:4711``."""
    if text.startswith("["):
        text = text[1:].partition("]")[0]
    elif text.count(":") == 1:
        text = text.partition(":")[0]
    try:
        return str(ipaddress.ip_address(text))
    except ValueError:
        return None
