"""Which addresses messages are sent to."""

import ipaddress
from urllib.parse import urlsplit

from engine.errors import OctasplatError

PORTS = (443, 8443)
MAX_URL = 2000


class AddressRefused(OctasplatError):
    """Messages are not sent to such an address."""


def check_url(url: str, allowed_hosts: tuple[str, ...] = ()) -> str:
    """The address itself, if messages may be sent there; a host name is looked up when sending, not here.

    Args:
        url: the address.
        allowed_hosts: names or numeric addresses, without a port, that may be inner ones and need neither
            TLS nor a usual port.

    Raises:
        AddressRefused: it is none, or leads where it must not.
    """
    try:
        parts = urlsplit(url)
        host, port = (parts.hostname or "").rstrip("."), parts.port
    except ValueError:
        raise AddressRefused(
            "The address cannot be read; give one such as https://example.org/hook."
        ) from None
    if len(url) > MAX_URL or any(c.isspace() or not c.isprintable() for c in url) or not host:
        raise AddressRefused("The address cannot be read; give one such as https://example.org/hook.")
    if parts.username is not None or parts.password is not None or parts.fragment:
        raise AddressRefused("The address must hold no user, password or fragment.")
    if is_allowed(host, allowed_hosts) and parts.scheme in ("http", "https"):
        return url
    if parts.scheme != "https":
        raise AddressRefused("The address must begin with https://.")
    if (port or 443) not in PORTS:
        raise AddressRefused(f"The address must have port {PORTS[0]} or {PORTS[1]}.")
    if _is_inner(host):
        raise AddressRefused("The address must be reachable from everywhere, not only from within a network.")
    return url


def is_allowed(host: str, allowed_hosts: tuple[str, ...]) -> bool:
    """Whether a host may be an inner one."""
    return host.lower() in {name.lower() for name in allowed_hosts}


def _is_inner(host: str) -> bool:
    """Whether it is surely an inner one; what a name leads to is only known when it is looked up."""
    try:
        return not ipaddress.ip_address(host).is_global
    except ValueError:
        name = host.lower()
        return "." not in name or name.endswith((".localhost", ".local", ".internal", ".home.arpa"))
