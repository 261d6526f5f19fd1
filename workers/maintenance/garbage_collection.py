"""Garbage collection of the storage: contents left by deleted, replaced and abandoned objects.

Kept are contents that the tables reference (so all results, whether pinned or not), the published results of
attempts that are not entered yet, as the next attempt will enter them, and contents that are being stored.
"""

import asyncio
import logging
import re
import time
import uuid
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

from octasplat.workers.db.connections import Connection, Pool, extend_timeouts
from octasplat.workers.db.references import references
from octasplat.workers.queue.storage_leases import (
    expire_stale_leases,
    mark_for_removal,
    oldest_lease,
    removal_transaction,
    unmark_for_removal,
)
from octasplat.workers.storage.protocol import Storage
from octasplat.workers.storage.trees import read_manifest
from octasplat.workers.storage.unreferenced import (
    RemovedContents,
    UnusedContent,
    find_unused,
    list_unreferenced,
    remove_contents,
    still_unreferenced,
)

logger = logging.getLogger(__name__)

REPLACED_SECONDS = 600.0
"""How long a replaced checkpoint stays for those who still read it."""
IMMEDIATE_INTERVAL_SECONDS = 3.0
"""How often contents are collected at once, at most."""
MAX_CLOCK_SKEW_SECONDS = 60.0
"""By how much the clocks of the store and the database may differ."""
_MIN_AGE_SECONDS = 2.0
MAX_COLLECTION_SECONDS = 3600
"""After so long others may collect although somebody still does."""
BATCH_SIZE = 50
"""Contents that are marked and removed together."""
INSTALLATION_DOCUMENT = "installation"
_RESULTS = re.compile(r"results/([0-9a-f-]{36})/\d+")


async def collect_garbage(
    pool: Pool,
    storage: Storage,
    *,
    unused_seconds: float,
    replaced_seconds: float = REPLACED_SECONDS,
    every_seconds: float = 0.0,
) -> RemovedContents | None:
    """Remove contents that nothing names, and documents of jobs that are gone.

    Args:
        pool: connections.
        storage: the store.
        unused_seconds: age from which contents that nothing names go; no upload may take longer.
        replaced_seconds: the same for contents of checkpoints and previews that were replaced.
        every_seconds: does nothing if the last time was less than this ago.

    Returns:
        What was removed; None if it was not the time, somebody else is at it, or the store is another
        database's.

    Raises:
        StorageError: the store does not do as asked.
    """
    async with _collection_turn(pool, storage, every_seconds) as ours:
        return await _collect(pool, storage, unused_seconds, replaced_seconds) if ours else None


async def collect_garbage_now(
    pool: Pool, storage: Storage, *, every_seconds: float = IMMEDIATE_INTERVAL_SECONDS
) -> RemovedContents | None:
    """Remove all unreferenced contents, whatever their age, because space is short.

    Contents that somebody stores at the moment and has yet to name are spared, see
    :mod:`octasplat.workers.queue.storage_leases`.

    Args:
        pool: connections.
        storage: the store.
        every_seconds: does nothing if the last time was less than this ago.

    Returns:
        What was removed; None as by :func:`collect_garbage`.

    Raises:
        StorageError: the store does not do as asked.
    """
    async with _collection_turn(pool, storage, every_seconds) as ours:
        return await _collect_now(pool, storage) if ours else None


@asynccontextmanager
async def _collection_turn(pool: Pool, storage: Storage, every_seconds: float) -> AsyncIterator[bool]:
    """Yield whether a collection is due and no other runs, which is then reserved for the block."""
    async with pool.connection() as connection, connection.transaction():
        cursor = await connection.execute(
            """
            SELECT id FROM installation
            WHERE collected_at <= clock_timestamp() - make_interval(secs => %s)
            FOR UPDATE SKIP LOCKED
            """,
            [every_seconds],
        )
        row = await cursor.fetchone()
        if row is None:
            yield False
            return
        if not await asyncio.to_thread(_is_own_store, storage, str(row["id"]).encode()):
            logger.warning("the store is another database's, so nothing in it is collected")
            yield False
            return
        # Nobody waits for this row; who finds it locked leaves the collecting to others.
        await extend_timeouts(connection, MAX_COLLECTION_SECONDS)
        yield True
        await connection.execute("UPDATE installation SET collected_at = clock_timestamp()")


def _is_own_store(storage: Storage, installation: bytes) -> bool:
    """Return whether the storage belongs to this database; an unclaimed one is claimed."""
    # Read first, as a full store takes not even this.
    known = storage.read_document(INSTALLATION_DOCUMENT)
    return (
        storage.publish_document(INSTALLATION_DOCUMENT, installation)
        if known is None
        else known == installation
    )


async def _collect(
    pool: Pool, storage: Storage, unused_seconds: float, replaced_seconds: float
) -> RemovedContents:
    now = time.time()
    async with pool.connection() as connection:
        await _expire_stale_leases(connection)
        async with connection.transaction():
            # One snapshot, so that the leases and the references are those of one moment.
            await connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ")
            began_unix = await _oldest_lease_unix(connection)
            named, entered = await _referenced_contents(connection)
            cursor = await connection.execute(
                "SELECT sha256 FROM replaced_contents WHERE replaced_at < now() - make_interval(secs => %s)",
                [replaced_seconds],
            )
            replaced = {row["sha256"] for row in await cursor.fetchall()}
        named |= await _published_results(connection, storage, entered)
        await connection.commit()  # what follows may take long
        found = await asyncio.to_thread(
            find_unused,
            storage,
            named,
            replaced,
            unused_before_unix=min(now - unused_seconds, began_unix),
            replaced_before_unix=min(now - replaced_seconds, began_unix),
        )
        removed = await _remove(connection, storage, found)
        await connection.execute("DELETE FROM replaced_contents WHERE sha256 = ANY(%s)", [list(replaced)])
    _log_removed(removed)
    return removed


async def _collect_now(pool: Pool, storage: Storage) -> RemovedContents:
    now = time.time()
    async with pool.connection() as connection:
        await _expire_stale_leases(connection)
        async with connection.transaction():
            named, _ = await _referenced_contents(connection)
        # Listed before the notes and names that count are read: whoever makes a note later and stores one of
        # these again makes it younger than it was in the list.
        found = await asyncio.to_thread(list_unreferenced, storage, named)
        async with connection.transaction():
            await connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ")
            began_unix = await _oldest_lease_unix(connection)
            named, entered = await _referenced_contents(connection)
        named |= await _published_results(connection, storage, entered)
        await connection.commit()
        limit_unix = min(now - _MIN_AGE_SECONDS, began_unix)
        removed = await _remove(connection, storage, still_unreferenced(found, named, before_unix=limit_unix))
    _log_removed(removed)
    return removed


async def _remove(
    connection: Connection, storage: Storage, contents: Sequence[UnusedContent]
) -> RemovedContents:
    """Remove contents in batches, each marked before, while no transaction can reference it.

    A process that stored one of them again in this moment waits until it is unmarked and then checks whether
    it exists, see :meth:`octasplat.workers.queue.storage_leases.StorageLease.verify`; or has referenced it
    before, and then it stays. The storage is accessed without any lock, as its answers may take long.
    """
    removed = RemovedContents()
    for start in range(0, len(contents), BATCH_SIZE):
        some = contents[start : start + BATCH_SIZE]
        async with removal_transaction(connection):
            named = await _referenced_now(connection, [content.sha256 for content in some])
            left = [content for content in some if content.sha256 not in named]
            digests = [content.sha256 for content in left]
            await mark_for_removal(connection, digests)
        try:
            removed += await asyncio.to_thread(remove_contents, storage, left)
        except asyncio.CancelledError:
            raise  # the thread goes on removing, so that the marks stay until they count no more
        except BaseException:
            await _unmark(connection, digests)
            raise
        await _unmark(connection, digests)
    return removed


async def _unmark(connection: Connection, digests: Sequence[str]) -> None:
    async with connection.transaction():
        await unmark_for_removal(connection, digests)


async def _referenced_now(connection: Connection, contents: Sequence[str]) -> set[str]:
    cursor = await connection.execute(
        """
        SELECT sha256 FROM owner_contents WHERE sha256 = ANY(%(contents)s)
        UNION SELECT preview->>'sha256' FROM jobs WHERE preview->>'sha256' = ANY(%(contents)s)
        UNION SELECT sha256 FROM live_scenes WHERE sha256 = ANY(%(contents)s)
        UNION SELECT views_sha256 FROM live_scenes WHERE views_sha256 = ANY(%(contents)s)
        """,
        {"contents": list(contents)},
    )
    return {row["sha256"] for row in await cursor.fetchall()}


async def _expire_stale_leases(connection: Connection) -> None:
    async with connection.transaction():
        await expire_stale_leases(connection)


async def _oldest_lease_unix(connection: Connection) -> float:
    """Return the time, by the storage's clock, before which no content of an open lease was stored; s."""
    began_at = await oldest_lease(connection)
    return began_at.timestamp() - MAX_CLOCK_SKEW_SECONDS if began_at is not None else float("inf")


async def _referenced_contents(connection: Connection) -> tuple[set[str], set[uuid.UUID]]:
    """Return the contents that the tables reference, and the jobs whose results are among them."""
    named = {reference.sha256 async for reference in references(connection)}
    cursor = await connection.execute("SELECT id FROM jobs WHERE state = 'succeeded'")
    return named, {row["id"] for row in await cursor.fetchall()}


def _log_removed(removed_contents: RemovedContents) -> None:
    if removed_contents.blobs:
        logger.info(
            "%d unused contents of %d bytes were removed", removed_contents.blobs, removed_contents.size_bytes
        )


async def _published_results(connection: Connection, storage: Storage, entered: set[uuid.UUID]) -> set[str]:
    """Return contents of published results in no table yet; those of deleted jobs are withdrawn."""
    found = await asyncio.to_thread(lambda: sorted(storage.list_documents("results/")))
    jobs = {name: uuid.UUID(match[1]) for name in found if (match := _RESULTS.fullmatch(name))}
    # Asked after the documents were listed: a job is there before its results are.
    cursor = await connection.execute("SELECT id FROM jobs WHERE id = ANY(%s)", [list(set(jobs.values()))])
    known = {row["id"] for row in await cursor.fetchall()}
    named: set[str] = set()
    for name, job_id in jobs.items():
        if job_id not in known:
            await asyncio.to_thread(storage.remove_document, name)
        elif job_id not in entered:
            manifest = await asyncio.to_thread(read_manifest, storage, name)
            named |= {file.sha256 for file in manifest.files} if manifest is not None else set()
    return named
