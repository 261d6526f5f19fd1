"""Throttling of wrong tokens: growing delays for a client.

Valid tokens are not throttled: they are random enough that looking each one up tells a guesser nothing.
"""

import asyncio
import time
from collections import OrderedDict
from dataclasses import dataclass

from octasplat.service.client_addresses import client_group

MAX_DELAY_SECONDS = 10.0
RESET_SECONDS = 600.0
MAX_WAITING = 4
"""Wrong tokens of one address whose answers are delayed at once; further ones are refused without a delay."""
_MAX_ADDRESSES = 10_000


@dataclass
class _ClientAttempts:
    wrong: int = 0
    waiting: int = 0
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

    def is_refused(self, address: str) -> bool:
        """Return whether too many wrong tokens of the address wait for their answers already."""
        return self._attempts_of_client(address).waiting >= MAX_WAITING

    async def delay_failure(self, address: str) -> bool:
        """Delay the answer; returns whether it is the address's first failure for a while."""
        client = self._attempts_of_client(address)
        client.wrong += 1
        client.last = time.monotonic()
        is_first = client.wrong == 1
        client.waiting += 1
        try:
            # The bound keeps the power from growing without end; it is far above the longest delay.
            await asyncio.sleep(min(MAX_DELAY_SECONDS, self._seconds * 1.5 ** min(client.wrong - 1, 40)))
        finally:
            client.waiting -= 1
        return is_first

    def _attempts_of_client(self, address: str) -> _ClientAttempts:
        group = client_group(address)
        # Put at the end again: the addresses that were quiet for longest are forgotten first.
        client = self._clients.pop(group, None)
        if client is None or (not client.waiting and time.monotonic() - client.last > RESET_SECONDS):
            client = _ClientAttempts()
        self._clients[group] = client
        if len(self._clients) > _MAX_ADDRESSES:
            self._clients.popitem(last=False)
        return client
