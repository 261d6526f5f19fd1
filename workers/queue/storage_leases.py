"""Leases on contents that are stored and will be referenced in a table afterwards; they are not collected.

A lease exists before the first byte is stored. A process references the contents in a transaction of
:meth:`StorageLease.reference`, which fails if the lease has expired, as that of a process without heartbeats
does.

Contents are removed from the storage without a lock, as that may take long. They are marked first, while no
transaction references anything (:func:`mark_for_removal`); a process that has stored one of them meanwhile
waits until it is unmarked and then checks whether it exists.
"""

import asyncio
import logging
import time
import uuid
from collections.abc import AsyncIterator, Collection
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import datetime

import psycopg
from psycopg_pool import PoolTimeout

from octasplat.workers.db.connections import Connection, Pool
from octasplat.workers.db.ids import new_id
from octasplat.workers.db.locks import STORE, lock_store
from octasplat.workers.storage.errors import BlobNotFoundError, StorageUnavailableError
from octasplat.workers.storage.protocol import Storage

logger = logging.getLogger(__name__)

RENEW_SECONDS = 10.0
"""How often whoever stores says that it still does."""
LEASE_SECONDS = 45.0
"""A note of which nothing was heard for so long is given up."""
MAX_REMOVAL_SECONDS = 300.0
"""A mark of removal that is older is one that a lost process left behind; it counts no more."""
MAX_WAIT_SECONDS = 60.0
"""For so long whoever names contents waits for those that are being removed at this moment."""
_POLL_SECONDS = 0.2
_CONNECTION_ERRORS = (psycopg.OperationalError, psycopg.InterfaceError, PoolTimeout, TimeoutError, OSError)


@dataclass(frozen=True)
class StorageLease:
    """A lease of a process that is storing contents.

    Attributes:
        id: of the row.
        pool: connections.
        storage: where.
        removals: how often contents had been marked for removal before; None if some were just then.
    """

    id: uuid.UUID
    pool: Pool
    storage: Storage
    removals: int | None

    async def verify(self, contents: Collection[str]) -> int:
        """Check that no content stored under the lease has been removed meanwhile.

        Args:
            contents: the digests of all that was stored.

        Returns:
            How often contents had been marked for removal when it was looked.

        Raises:
            StorageUnavailableError: the note was given up, or some of it is gone; it is to be stored again.
        """
        deadline = time.monotonic() + MAX_WAIT_SECONDS
        while True:
            async with self.pool.connection() as connection:
                await self._check_held(connection, lock=False)
                removals = await _removal_count(connection)
                is_removing = await _are_being_removed(connection, contents)
            if not is_removing:
                break
            if time.monotonic() > deadline:
                raise StorageUnavailableError("Contents are being removed from the store; store them again.")
            await asyncio.sleep(_POLL_SECONDS)
        # Else nothing was marked since before the first byte, and all that was stored is there.
        if removals != self.removals:
            missing = await asyncio.to_thread(_missing_contents, self.storage, contents)
            if missing:
                raise StorageUnavailableError(
                    f"{len(missing)} contents were removed meanwhile; store them again."
                )
        return removals

    @asynccontextmanager
    async def reference(self, contents: Collection[str]) -> AsyncIterator[Connection]:
        """Yield a transaction that references contents; none of them is removed until it ends.

        Args:
            contents: their digests.

        Raises:
            StorageUnavailableError: as by :meth:`verify`.
        """
        while True:
            looked = await self.verify(contents)
            async with self.pool.connection() as connection, connection.transaction():
                await lock_store(connection, shared=True)
                if await _removal_count(connection) != looked:
                    continue  # contents were marked in between
                await self._check_held(connection, lock=True)
                yield connection
                return

    async def _check_held(self, connection: Connection, *, lock: bool) -> None:
        query = "SELECT id FROM storing WHERE id = %s"
        # Held until the references are written, as expire_stale_leases skips locked rows.
        cursor = await connection.execute(f"{query} FOR KEY SHARE" if lock else query, [self.id])
        if await cursor.fetchone() is None:
            raise StorageUnavailableError(
                "Whoever stored this was silent for too long, so it may be gone; store it again."
            )


@asynccontextmanager
async def storage_lease(pool: Pool, storage: Storage) -> AsyncIterator[StorageLease]:
    """Yield a lease for the block, in which contents are stored and then referenced."""
    async with pool.connection() as connection:
        # Of the version before, removals hold the lock instead of marking what they remove.
        cursor = await connection.execute("SELECT pg_try_advisory_xact_lock_shared(%s) AS quiet", [STORE])
        row = await cursor.fetchone()
        # None is no count, so that verify() then looks for each content.
        is_quiet = row is not None and row["quiet"] and not await _are_being_removed(connection, None)
        note = StorageLease(new_id(), pool, storage, await _removal_count(connection) if is_quiet else None)
        await connection.execute("INSERT INTO storing (id) VALUES (%s)", [note.id])
    renewal = asyncio.create_task(_renew(pool, note))
    try:
        yield note
    finally:
        renewal.cancel()
        # Also where the block was canceled, else the row would hold back the collection until it is stale.
        await asyncio.shield(_release(pool, note))


@asynccontextmanager
async def removal_transaction(connection: Connection) -> AsyncIterator[None]:
    """Yield a transaction in which no other references contents, for :func:`mark_for_removal`."""
    async with connection.transaction():
        await lock_store(connection, shared=False)
        await connection.execute("SELECT nextval('octasplat_removals')")
        yield


async def mark_for_removal(connection: Connection, contents: Collection[str]) -> None:
    """Mark unreferenced contents as being removed, in a transaction of :func:`removal_transaction`."""
    await connection.execute(
        """
        INSERT INTO removing_contents (sha256) SELECT unnest(%s::text[])
        ON CONFLICT (sha256) DO UPDATE SET since = clock_timestamp()
        """,
        [sorted(contents)],
    )


async def unmark_for_removal(connection: Connection, contents: Collection[str]) -> None:
    """Unmark contents after they were removed, or kept after all."""
    await connection.execute("DELETE FROM removing_contents WHERE sha256 = ANY(%s)", [list(contents)])


async def contents_being_removed(connection: Connection, contents: Collection[str]) -> set[str]:
    """Return which of these contents are marked for removal at present."""
    cursor = await connection.execute(
        """
        SELECT sha256 FROM removing_contents
        WHERE sha256 = ANY(%s) AND since > clock_timestamp() - make_interval(secs => %s)
        """,
        [list(contents), MAX_REMOVAL_SECONDS],
    )
    return {row["sha256"] for row in await cursor.fetchall()}


async def oldest_lease(connection: Connection) -> datetime | None:
    """Return when the oldest lease in force was made; None if nobody stores anything."""
    cursor = await connection.execute("SELECT min(began_at) AS began_at FROM storing")
    row = await cursor.fetchone()
    return row["began_at"] if row is not None else None


async def expire_stale_leases(connection: Connection) -> None:
    """Expire the leases of processes that are gone; one that is being confirmed stays."""
    await connection.execute(
        """
        DELETE FROM storing WHERE id IN (
            SELECT id FROM storing WHERE seen_at < clock_timestamp() - make_interval(secs => %s)
            FOR UPDATE SKIP LOCKED
        )
        """,
        [LEASE_SECONDS],
    )


async def _renew(pool: Pool, lease: StorageLease) -> None:
    while True:
        await asyncio.sleep(RENEW_SECONDS)
        try:
            async with pool.connection() as connection:
                await connection.execute(
                    "UPDATE storing SET seen_at = clock_timestamp() WHERE id = %s", [lease.id]
                )
        except _CONNECTION_ERRORS:
            continue
        except Exception:
            logger.exception("a note of what is stored was not renewed and is tried again")


async def _release(pool: Pool, lease: StorageLease) -> None:
    try:
        async with pool.connection() as connection:
            await connection.execute("DELETE FROM storing WHERE id = %s", [lease.id])
    except _CONNECTION_ERRORS as error:
        logger.info("a note of what is stored stays for a while: %s", error)


async def _are_being_removed(connection: Connection, contents: Collection[str] | None) -> bool:
    """Return whether any of these contents, or any at all, are being removed."""
    cursor = await connection.execute(
        """
        SELECT EXISTS (
            SELECT FROM removing_contents
            WHERE since > clock_timestamp() - make_interval(secs => %(seconds)s)
              AND (%(contents)s::text[] IS NULL OR sha256 = ANY(%(contents)s))
        ) AS found
        """,
        {"seconds": MAX_REMOVAL_SECONDS, "contents": None if contents is None else list(contents)},
    )
    row = await cursor.fetchone()
    return row is not None and bool(row["found"])


async def _removal_count(connection: Connection) -> int:
    cursor = await connection.execute("SELECT last_value + is_called::int AS n FROM octasplat_removals")
    row = await cursor.fetchone()
    assert row is not None
    return int(row["n"])


def _missing_contents(storage: Storage, contents: Collection[str]) -> list[str]:
    missing = []
    for sha256 in contents:
        try:
            storage.stat(sha256)
        except BlobNotFoundError:
            missing.append(sha256)
    return missing
