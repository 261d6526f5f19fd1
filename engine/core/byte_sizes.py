"""Sizes of memory as users write them."""

import re

from octasplat.engine.core.errors import ConfigError

_FACTORS = {"": 1, "K": 10**3, "M": 10**6, "G": 10**9, "T": 10**12}


def parse_bytes(text: str) -> int:
    """Return the bytes that ``8G``, ``500M`` or a plain number mean; G is 10^9.

    >>> parse_bytes("8G"), parse_bytes("1.5 GB"), parse_bytes("4096")
    (8000000000, 1500000000, 4096)

    Raises:
        ConfigError: it is no size.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)B?", text.strip(), re.IGNORECASE)
    if match is None:
        raise ConfigError(f"'{text}' is no size of memory; write it as 8G or 500M.")
    return round(float(match[1]) * _FACTORS[match[2].upper()])
