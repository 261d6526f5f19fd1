"""Eviction of unreferenced contents when space for uploads is short, before uploads are refused."""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import psycopg
from psycopg_pool import PoolTimeout

from octasplat.service.thread_pools import ThreadPurpose, run_in_pool
from octasplat.workers.cancellation import cancel_and_wait
from octasplat.workers.db.connections import Pool
from octasplat.workers.maintenance.garbage_collection import collect_garbage_now
from octasplat.workers.queue.storage_leases import StorageLease, storage_lease
from octasplat.workers.storage.errors import StorageError, StorageFullError
from octasplat.workers.storage.protocol import Storage

logger = logging.getLogger(__name__)

LOW_SPACE_BYTES = 1 << 30
"""With less than this above the floor, what was deleted goes at once, not only when the room is needed."""


class SpaceEvictor:
    """Frees space in a storage.

    Args:
        pool: connections.
        storage: the store.
    """

    def __init__(self, pool: Pool, storage: Storage) -> None:
        self._pool = pool
        self._storage = storage
        self._is_low = False
        self._tasks: set[asyncio.Task[None]] = set()

    @asynccontextmanager
    async def upload_lease(self, size_bytes: int | None) -> AsyncIterator[StorageLease]:
        """Yield a lease for an upload, under which the block stores and references contents.

        Args:
            size_bytes: how much will come, if it is known.

        Raises:
            StorageFullError: it does not fit even without all that nobody names.
        """
        try:
            await run_in_pool(ThreadPurpose.UPLOADS, self._storage.ensure_space, size_bytes or 0)
        except StorageFullError:
            self._is_low = True
            await self._evict()
            await run_in_pool(ThreadPurpose.UPLOADS, self._storage.ensure_space, size_bytes or 0)
        try:
            async with storage_lease(self._pool, self._storage) as note:
                yield note
        except StorageFullError:  # only now, as nothing goes while it is being stored; the next try may fit
            self._is_low = True
            await self._evict()
            raise

    def evict_if_low_later(self) -> None:
        """Evict unreferenced contents in the background if space is low; called after deletions."""
        task = asyncio.create_task(self._evict_if_low())
        # The event loop itself holds tasks weakly only.
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def close(self) -> None:
        """Cancel the evictions in progress."""
        await cancel_and_wait(self._tasks)

    async def _evict_if_low(self) -> None:
        try:
            free = await run_in_pool(ThreadPurpose.STORE_CHECKS, self._storage.free_bytes)
        except StorageError:
            return
        if self._is_low or (free is not None and free < LOW_SPACE_BYTES):
            await self._evict()
            free = await run_in_pool(ThreadPurpose.STORE_CHECKS, self._storage.free_bytes)
            self._is_low = self._is_low and (free is None or free < LOW_SPACE_BYTES)

    async def _evict(self) -> None:
        try:
            await collect_garbage_now(self._pool, self._storage)
        except (StorageError, psycopg.Error, PoolTimeout) as error:
            logger.info("unused contents were not collected: %s", error)
