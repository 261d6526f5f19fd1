"""Wrong tokens: whoever tries them out waits, longer each time, and does not keep others waiting."""

import asyncio
import hashlib
import ipaddress
import time
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

LONGEST_SECONDS = 10.0
FORGET_SECONDS = 600.0
MOST_AT_ONCE = 4
"""Unknown tokens of an address that has sent a wrong one that may be under way; more are not looked at."""
MOST_OF_STRANGERS = 32
"""The same of an address that has not."""
_MOST_ADDRESSES = 10_000
_MOST_KNOWN = 10_000


@dataclass
class _Guesser:
    wrong: int = 0
    under_way: int = 0
    last: float = 0.0


class Guesses:
    """Counts wrong tokens by the address that they come from.

    Args:
        seconds: how long the first one waits for its answer; each further one half as long again. 0 lets all
            go on at once.
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds
        self._guessers: OrderedDict[str, _Guesser] = OrderedDict()
        self._known: OrderedDict[bytes, None] = OrderedDict()

    @contextmanager
    def attempt(self, address: str, secret: str) -> Iterator[bool]:
        """Around looking at a secret and the answer; yields False if it is not to be looked at now.

        Secrets that were right before always are.
        """
        if _digest(secret) in self._known:
            yield True
            return
        guesser = self._guesser(address)
        if guesser.under_way >= (MOST_AT_ONCE if guesser.wrong else MOST_OF_STRANGERS):
            yield False
            return
        guesser.under_way += 1
        try:
            yield True
        finally:
            guesser.under_way -= 1

    def was_right(self, secret: str) -> None:
        """Remember a secret that was let in."""
        self._known[_digest(secret)] = None
        self._known.move_to_end(_digest(secret))
        if len(self._known) > _MOST_KNOWN:
            self._known.popitem(last=False)

    async def was_wrong(self, address: str) -> bool:
        """Wait before the answer; returns whether it is the first wrong one of the address for a while."""
        guesser = self._guesser(address)
        guesser.wrong += 1
        guesser.last = time.monotonic()
        is_first = guesser.wrong == 1
        await asyncio.sleep(min(LONGEST_SECONDS, self._seconds * 1.5 ** min(guesser.wrong - 1, 40)))
        return is_first

    def _guesser(self, address: str) -> _Guesser:
        group = _group(address)
        guesser = self._guessers.pop(group, None)
        if guesser is None or (not guesser.under_way and time.monotonic() - guesser.last > FORGET_SECONDS):
            guesser = _Guesser()
        self._guessers[group] = guesser
        if len(self._guessers) > _MOST_ADDRESSES:
            self._guessers.popitem(last=False)
        return guesser


def _digest(secret: str) -> bytes:
    return hashlib.sha256(secret.encode()).digest()


def _group(address: str) -> str:
    """What one guesser has for certain: an IPv4 address, or 64 bits of IPv6."""
    try:
        parsed = ipaddress.ip_address(address)
    except ValueError:
        return address
    return str(ipaddress.ip_network((parsed, 64), strict=False)) if parsed.version == 6 else str(parsed)
