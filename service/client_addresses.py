"""Addresses of clients, as limits and trust are given by them."""

import ipaddress

IPAddress = ipaddress.IPv4Address | ipaddress.IPv6Address
_CLIENT_PREFIX = 64
"""Bits of an address of IPv6 that one client owns all the rest of."""


def parse_client_address(text: str) -> IPAddress | None:
    """Return a client's address, as IPv4 where a socket of both protocols shows such a one as IPv6.

    None where the text is no address.
    """
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        return None
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        return address.ipv4_mapped
    return address


def client_group(text: str) -> str:
    """Return the part of an address that one client owns: an IPv4 address, or 64 bits of IPv6."""
    address = parse_client_address(text)
    if address is None:
        return text
    if address.version == 4:
        return str(address)
    return str(ipaddress.ip_network((address, _CLIENT_PREFIX), strict=False))
