"""Throttling of wrong tokens: growing delays for a client, without delaying others."""

import asyncio
import hashlib
import ipaddress
import time
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

MAX_DELAY_SECONDS = 10.0
RESET_SECONDS = 600.0
MAX_CONCURRENT_AFTER_FAILURE = 4
"""Unknown tokens of an address that has sent a wrong one that may be under way; more are not looked at."""
MAX_CONCURRENT = 32
"""The same of an address that has not."""
_MAX_ADDRESSES = 10_000
_MAX_KNOWN_SECRETS = 10_000


@dataclass
class _ClientAttempts:
    wrong: int = 0
    under_way: int = 0
    last: float = 0.0


class LoginThrottle:
    """Counts wrong tokens by client address.

    Args:
        seconds: how long the first one waits for its answer; each further one half as long again. 0 lets all
            go on at once.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._clients: OrderedDict[str, _ClientAttempts] = OrderedDict()
        self._known_digests: OrderedDict[bytes, None] = OrderedDict()

    @contextmanager
    def attempt(self, address: str, secret: str) -> Iterator[bool]:
        """Hold the place of an attempt for the block; yields False if the secret must not be checked now.

        Secrets that were right before always are.
        """
        if _secret_digest(secret) in self._known_digests:
            yield True
            return
        guesser = self._attempts_of_client(address)
        if guesser.under_way >= (MAX_CONCURRENT_AFTER_FAILURE if guesser.wrong else MAX_CONCURRENT):
            yield False
            return
        guesser.under_way += 1
        try:
            yield True
        finally:
            guesser.under_way -= 1

    def record_success(self, secret: str) -> None:
        """Remember a valid secret."""
        self._known_digests[_secret_digest(secret)] = None
        self._known_digests.move_to_end(_secret_digest(secret))
        if len(self._known_digests) > _MAX_KNOWN_SECRETS:
            self._known_digests.popitem(last=False)

    async def delay_failure(self, address: str) -> bool:
        """Delay the answer; returns whether it is the address's first failure for a while."""
        guesser = self._attempts_of_client(address)
        guesser.wrong += 1
        guesser.last = time.monotonic()
        is_first = guesser.wrong == 1
        await asyncio.sleep(min(MAX_DELAY_SECONDS, self._seconds * 1.5 ** min(guesser.wrong - 1, 40)))
        return is_first

    def _attempts_of_client(self, address: str) -> _ClientAttempts:
        group = _client_key(address)
        guesser = self._clients.pop(group, None)
        if guesser is None or (not guesser.under_way and time.monotonic() - guesser.last > RESET_SECONDS):
            guesser = _ClientAttempts()
        self._clients[group] = guesser
        if len(self._clients) > _MAX_ADDRESSES:
            self._clients.popitem(last=False)
        return guesser


def _secret_digest(secret: str) -> bytes:
    return hashlib.sha256(secret.encode()).digest()


def _client_key(address: str) -> str:
    """Return the part of an address that one client owns: an IPv4 address, or 64 bits of IPv6."""
    try:
        parsed = ipaddress.ip_address(address)
    except ValueError:
        return address
    return str(ipaddress.ip_network((parsed, 64), strict=False)) if parsed.version == 6 else str(parsed)
