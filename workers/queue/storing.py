"""Notes of who stores contents and will name them in a table only afterwards, so that nobody collects them.

A note is there before the first byte is stored. Whoever names the contents confirms it in the same
transaction, which fails if the note was given up: that of a process that was silent for long counts no more.
"""

import asyncio
import logging
import uuid
from collections.abc import AsyncIterator, Collection
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import datetime

import psycopg
from psycopg_pool import PoolTimeout

from octasplat.workers.records.database import Connection, Pool
from octasplat.workers.records.ids import new_id
from octasplat.workers.store.errors import BlobMissing, StorageUnavailable
from octasplat.workers.store.protocol import Storage

logger = logging.getLogger(__name__)

SEEN_SECONDS = 10.0
"""How often whoever stores says that it still does."""
SILENT_SECONDS = 45.0
"""A note of which nothing was heard for so long is given up."""
_LOCK = 0x73746F72  # "stor"
_UNREACHABLE = (psycopg.OperationalError, psycopg.InterfaceError, PoolTimeout, TimeoutError, OSError)


@dataclass(frozen=True)
class Note:
    """Says that something is being stored.

    Attributes:
        id: of the row.
        storage: where.
        removals: how often contents had been removed before; None if some were just then.
    """

    id: uuid.UUID
    storage: Storage
    removals: int | None

    async def confirm(self, connection: Connection, contents: Collection[str]) -> None:
        """Make sure that nothing stored meanwhile is collected before the transaction of ``connection`` ends.

        Args:
            connection: of the transaction that names the contents.
            contents: their digests.

        Raises:
            StorageUnavailable: the note was given up, or some of it was removed in the moment when it was
                stored; it is to be stored again.
        """
        cursor = await connection.execute("SELECT id FROM storing WHERE id = %s FOR KEY SHARE", [self.id])
        if await cursor.fetchone() is None:
            raise StorageUnavailable(
                "Whoever stored this was silent for too long, so it may be gone; store it again."
            )
        await connection.execute("SELECT pg_advisory_xact_lock_shared(%s)", [_LOCK])
        if await _removals(connection) != self.removals:
            gone = await asyncio.to_thread(_missing, self.storage, contents)
            if gone:
                raise StorageUnavailable(f"{len(gone)} contents were removed meanwhile; store them again.")


@asynccontextmanager
async def storing(pool: Pool, storage: Storage) -> AsyncIterator[Note]:
    """A note for as long as the block runs, in which contents are stored and then named."""
    async with pool.connection() as connection:
        cursor = await connection.execute("SELECT pg_try_advisory_xact_lock_shared(%s) AS quiet", [_LOCK])
        row = await cursor.fetchone()
        is_quiet = row is not None and row["quiet"]
        note = Note(new_id(), storage, await _removals(connection) if is_quiet else None)
        await connection.execute("INSERT INTO storing (id) VALUES (%s)", [note.id])
    seen = asyncio.create_task(_say_so(pool, note))
    try:
        yield note
    finally:
        seen.cancel()
        await asyncio.shield(_remove(pool, note))


async def removing(connection: Connection) -> None:
    """Until the transaction ends nobody names contents, which may be removed; call this before."""
    await connection.execute("SELECT pg_advisory_xact_lock(%s)", [_LOCK])
    await connection.execute("SELECT nextval('octasplat_removals')")


async def oldest_note(connection: Connection) -> datetime | None:
    """When the oldest note in force was made; None if nobody stores anything."""
    cursor = await connection.execute("SELECT min(began_at) AS began_at FROM storing")
    row = await cursor.fetchone()
    return row["began_at"] if row is not None else None


async def give_up_silent(connection: Connection) -> None:
    """Give up the notes of processes that are gone; one that is being confirmed stays."""
    await connection.execute(
        """
        DELETE FROM storing WHERE id IN (
            SELECT id FROM storing WHERE seen_at < clock_timestamp() - make_interval(secs => %s)
            FOR UPDATE SKIP LOCKED
        )
        """,
        [SILENT_SECONDS],
    )


async def _say_so(pool: Pool, note: Note) -> None:
    while True:
        await asyncio.sleep(SEEN_SECONDS)
        try:
            async with pool.connection() as connection:
                await connection.execute(
                    "UPDATE storing SET seen_at = clock_timestamp() WHERE id = %s", [note.id]
                )
        except _UNREACHABLE:
            continue
        except Exception:
            logger.exception("a note of what is stored was not renewed and is tried again")


async def _remove(pool: Pool, note: Note) -> None:
    try:
        async with pool.connection() as connection:
            await connection.execute("DELETE FROM storing WHERE id = %s", [note.id])
    except _UNREACHABLE as error:
        logger.info("a note of what is stored stays for a while: %s", error)


async def _removals(connection: Connection) -> int:
    cursor = await connection.execute("SELECT last_value + is_called::int AS n FROM octasplat_removals")
    row = await cursor.fetchone()
    assert row is not None
    return int(row["n"])


def _missing(storage: Storage, contents: Collection[str]) -> list[str]:
    gone = []
    for sha256 in contents:
        try:
            storage.stat(sha256)
        except BlobMissing:
            gone.append(sha256)
    return gone
