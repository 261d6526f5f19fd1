"""Check of the network addresses that webhooks may be sent to."""

import ipaddress
import re
import unicodedata
from urllib.parse import urlsplit

from octasplat.engine.core.errors import OctasplatError

PORTS = (443, 8443)
MAX_URL = 2000
IPAddress = ipaddress.IPv4Address | ipaddress.IPv6Address
# Behind these, the last 32 bits are an IPv4 address that is meant.
_IPV4_EMBEDDING_NETWORKS = tuple(
    map(ipaddress.IPv6Network, ("64:ff9b::/96", "::/96", "::ffff:0:0:0/96"))  # NAT64, compatible, SIIT
)
_LOCAL_NAT64 = ipaddress.IPv6Network("64:ff9b:1::/48")
"""Translated within one's own network only (RFC 8215), to where nobody outside can know."""
_NUMERIC_LABEL = re.compile(r"[0-9]+|0[xX][0-9a-fA-F]*")


class AddressRefusedError(OctasplatError):
    """Messages may not be sent to this address."""

    error_type = "address_refused"


def check_url(url: str, allowed_hosts: tuple[str, ...] = (), *, max_length: int = MAX_URL) -> str:
    """Return the URL if messages may be sent there; a host name is looked up when sending, not here.

    Args:
        url: the address.
        allowed_hosts: names or numeric addresses, without a port, that may be inner ones and need neither
            TLS nor a usual port.
        max_length: characters.

    Raises:
        AddressRefusedError: it is none, or leads where it must not.
    """
    try:
        parts = urlsplit(url)
        host, port = (parts.hostname or "").rstrip("."), parts.port
    except ValueError:
        raise AddressRefusedError(
            "The address cannot be read; give one such as https://example.org/hook."
        ) from None
    if len(url) > max_length or any(c.isspace() or not c.isprintable() for c in url) or not host:
        raise AddressRefusedError("The address cannot be read; give one such as https://example.org/hook.")
    if parts.username is not None or parts.password is not None or parts.fragment:
        raise AddressRefusedError("The address must hold no user, password or fragment.")
    if is_allowed(host, allowed_hosts) and parts.scheme in ("http", "https"):
        return url
    if parts.scheme != "https":
        raise AddressRefusedError("The address must begin with https://.")
    if (port or 443) not in PORTS:
        raise AddressRefusedError(f"The address must have port {PORTS[0]} or {PORTS[1]}.")
    if _is_internal(host):
        raise AddressRefusedError(
            "The address must be reachable from everywhere, not only from within a network."
        )
    return url


def is_allowed(host: str, allowed_hosts: tuple[str, ...]) -> bool:
    """Return whether a host may have an internal address."""
    return host.lower().rstrip(".") in {name.lower() for name in allowed_hosts}


def parse_address(text: str) -> IPAddress:
    """Return a numeric address, also with the zone of a link.

    Raises:
        ValueError: it is none.
    """
    return ipaddress.ip_address(text.partition("%")[0])


def is_public(address: IPAddress) -> bool:
    """Return whether an address is one of the public network, also where it stands for an IPv4 address."""
    if isinstance(address, ipaddress.IPv6Address):
        embedded = address.ipv4_mapped or address.sixtofour
        if embedded is None and any(address in network for network in _IPV4_EMBEDDING_NETWORKS):
            embedded = ipaddress.IPv4Address(address.packed[-4:])
        if embedded is not None:
            return embedded.is_global and not embedded.is_multicast
        if address in _LOCAL_NAT64 or address.teredo is not None:
            return False
    return address.is_global and not address.is_multicast


def _is_internal(host: str) -> bool:
    """Return whether an address is certainly internal; a host name is only known after its lookup."""
    # Full-width digits and dots are plain ones to whoever looks the name up.
    name = unicodedata.normalize("NFKC", host).replace("\N{IDEOGRAPHIC FULL STOP}", ".").lower().rstrip(".")
    try:
        return not is_public(parse_address(name))
    except ValueError:
        pass
    if _NUMERIC_LABEL.fullmatch(name.rpartition(".")[2]):
        return True  # 127.1, 0x7f.1 or 2130706433: an address in a spelling that hides which one
    return "." not in name or name.endswith((".localhost", ".local", ".internal", ".home.arpa"))
