"""Ids that sort by creation time: UUID version 7 (RFC 9562)."""

import secrets
import time
import uuid


def new_id() -> uuid.UUID:
    """Return a fresh UUIDv7: 48 bits of Unix time in ms, 12 bits of the fraction of it, 62 random bits."""
    nanoseconds = time.time_ns()
    milliseconds, rest = divmod(nanoseconds, 1_000_000)
    fraction = rest * 4096 // 1_000_000
    # Version 7 is in bits 76 to 79, variant 0b10 in bits 62 and 63.
    value = (milliseconds << 80) | (7 << 76) | (fraction << 64) | (2 << 62) | secrets.randbits(62)
    return uuid.UUID(int=value)
