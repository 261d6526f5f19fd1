"""Thread pools by purpose, so that slow or numerous work does not delay other work."""

import asyncio
import contextvars
import functools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from enum import Enum, auto
from typing import TypeVar

T = TypeVar("T")


class ThreadPurpose(Enum):
    """Purposes that have a thread pool of their own."""

    UPLOADS = auto()
    """Writing what is sent, and looking at its headers."""
    UNPACKING = auto()
    """Reading archives that have come."""
    CHECKS = auto()
    """Checking datasets; :mod:`octasplat.service.actions.task_runner` bounds how many at once."""
    OPTIONS = auto()
    """Validating options, a stage's text among them."""
    MESHES = auto()
    """Checking meshes of jobs before these are queued, in child processes."""
    BODIES = auto()
    """Counting what bodies hold before they are parsed."""
    DOWNLOADS = auto()
    """Looking up what is read."""
    STORE_CHECKS = auto()
    """Checking the state of the store."""


_POOL_SIZES = {
    ThreadPurpose.UPLOADS: 16,
    ThreadPurpose.UNPACKING: 3,
    ThreadPurpose.CHECKS: 8,
    ThreadPurpose.OPTIONS: 2,
    ThreadPurpose.MESHES: 2,
    ThreadPurpose.BODIES: 2,
    ThreadPurpose.DOWNLOADS: 12,
    ThreadPurpose.STORE_CHECKS: 4,
}
_POOLS = {purpose: ThreadPoolExecutor(most, purpose.name.lower()) for purpose, most in _POOL_SIZES.items()}


async def run_in_pool(
    purpose: ThreadPurpose, function: Callable[..., T], /, *values: object, **named: object
) -> T:
    """Call a blocking function in a thread of the pool for ``purpose``; as :func:`asyncio.to_thread`."""
    # With the context, as lines of the log name the request that it holds.
    call = functools.partial(contextvars.copy_context().run, function, *values, **named)
    return await asyncio.get_running_loop().run_in_executor(_POOLS[purpose], call)
