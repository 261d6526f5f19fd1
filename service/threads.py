"""Threads by purpose, so that what is slow or comes in numbers keeps nothing else waiting."""

import asyncio
import contextvars
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from enum import Enum, auto
from typing import TypeVar

T = TypeVar("T")


class Threads(Enum):
    """What threads are for."""

    UPLOADS = auto()
    """Writing what is sent, and looking at its headers."""
    UNPACKING = auto()
    """Reading archives that have come."""
    CHECKS = auto()
    """Checking datasets; how many at once is bounded further, see :class:`octasplat.service.gate.Gate`."""
    DOWNLOADS = auto()
    """Looking up what is read."""
    LOOKS = auto()
    """Asking how the store fares."""


_MOST = {
    Threads.UPLOADS: 16,
    Threads.UNPACKING: 3,
    Threads.CHECKS: 8,
    Threads.DOWNLOADS: 12,
    Threads.LOOKS: 4,
}
_POOLS = {purpose: ThreadPoolExecutor(most, purpose.name.lower()) for purpose, most in _MOST.items()}


async def in_thread(purpose: Threads, function: Callable[..., T], /, *values: object, **named: object) -> T:
    """Call a function that blocks in one of the threads for ``purpose``; as :func:`asyncio.to_thread`."""
    call = functools.partial(contextvars.copy_context().run, function, *values, **named)
    return await asyncio.get_running_loop().run_in_executor(_POOLS[purpose], call)
