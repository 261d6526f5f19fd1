"""Room for uploads: what nobody names any more goes when it is short, before anybody is refused."""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import psycopg
from psycopg_pool import PoolTimeout

from octasplat.service.threads import Threads, in_thread
from octasplat.workers.ending import end
from octasplat.workers.queue.storing import Note, storing
from octasplat.workers.records.database import Pool
from octasplat.workers.store.errors import StorageError, StorageFull
from octasplat.workers.store.protocol import Storage
from octasplat.workers.upkeep.collecting import collect_at_once

logger = logging.getLogger(__name__)

SHORT_BYTES = 1 << 30
"""With less than this above the floor, what was deleted goes at once, not only when the room is needed."""


class RoomMaker:
    """Makes room in a store.

    Args:
        pool: connections.
        storage: the store.
    """

    def __init__(self, pool: Pool, storage: Storage) -> None:
        self._pool = pool
        self._storage = storage
        self._short = False
        self._tasks: set[asyncio.Task[None]] = set()

    @asynccontextmanager
    async def upload(self, size_bytes: int | None) -> AsyncIterator[Note]:
        """For an upload: the block stores contents and names them, under the note that it is given.

        Args:
            size_bytes: how much will come, if it is known.

        Raises:
            StorageFull: it does not fit even without all that nobody names.
        """
        try:
            await in_thread(Threads.UPLOADS, self._storage.ensure_room, size_bytes or 0)
        except StorageFull:
            self._short = True
            await self._make()
            await in_thread(Threads.UPLOADS, self._storage.ensure_room, size_bytes or 0)
        try:
            async with storing(self._pool, self._storage) as note:
                yield note
        except StorageFull:  # only now, as nothing goes while it is being stored; the next try may fit
            self._short = True
            await self._make()
            raise

    def after_deletion(self) -> None:
        """Something was deleted: its contents go now if room is short."""
        task = asyncio.create_task(self._make_if_short())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def close(self) -> None:
        """Give up what is under way."""
        await end(self._tasks)

    async def _make_if_short(self) -> None:
        try:
            free = await in_thread(Threads.LOOKS, self._storage.free_bytes)
        except StorageError:
            return
        if self._short or (free is not None and free < SHORT_BYTES):
            await self._make()
            free = await in_thread(Threads.LOOKS, self._storage.free_bytes)
            self._short = self._short and (free is None or free < SHORT_BYTES)

    async def _make(self) -> None:
        try:
            await collect_at_once(self._pool, self._storage)
        except (StorageError, psycopg.Error, PoolTimeout) as error:
            logger.info("unused contents were not collected: %s", error)
