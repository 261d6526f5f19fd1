"""Collecting what deleted, replaced and abandoned things have left in the store.

What stays: everything in the tables (so all results, whether pinned or not), and the published results of
attempts that did not get to enter them, as the next attempt will.
"""

import asyncio
import logging
import re
import time
import uuid

from workers.records.database import Connection, Pool
from workers.records.references import references
from workers.store.collect import Collected, collect_unused
from workers.store.protocol import Storage
from workers.store.trees import read_manifest

logger = logging.getLogger(__name__)

REPLACED_SECONDS = 600.0
"""How long a replaced checkpoint stays for those who still read it."""
INSTALLATION = "installation"
_RESULTS = re.compile(r"results/([0-9a-f-]{36})/\d+")


async def collect(
    pool: Pool,
    storage: Storage,
    *,
    unused_seconds: float,
    replaced_seconds: float = REPLACED_SECONDS,
    every_seconds: float = 0.0,
) -> Collected | None:
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
    async with pool.connection() as connection, connection.transaction():
        cursor = await connection.execute(
            """
            SELECT id FROM installation WHERE collected_at <= now() - make_interval(secs => %s)
            FOR UPDATE SKIP LOCKED
            """,
            [every_seconds],
        )
        row = await cursor.fetchone()
        if row is None:
            return None
        # A store that is nobody's becomes this database's.
        if not await asyncio.to_thread(storage.publish, INSTALLATION, str(row["id"]).encode()):
            logger.warning("the store is another database's, so nothing in it is collected")
            return None
        await connection.execute("UPDATE installation SET collected_at = now()")
        return await _collect(pool, storage, unused_seconds, replaced_seconds)


async def _collect(pool: Pool, storage: Storage, unused_seconds: float, replaced_seconds: float) -> Collected:
    now = time.time()
    async with pool.connection() as connection:
        async with connection.transaction():
            await connection.execute("SET TRANSACTION ISOLATION LEVEL REPEATABLE READ")
            named = {reference.sha256 async for reference in references(connection)}
            cursor = await connection.execute("SELECT id FROM jobs WHERE state = 'succeeded'")
            entered = {row["id"] for row in await cursor.fetchall()}
            cursor = await connection.execute(
                "SELECT sha256 FROM replaced_contents WHERE replaced_at < now() - make_interval(secs => %s)",
                [replaced_seconds],
            )
            replaced = {row["sha256"] for row in await cursor.fetchall()}
        named |= await _published(connection, storage, entered)
        removed = await asyncio.to_thread(
            collect_unused,
            storage,
            named,
            replaced,
            unused_before_unix=now - unused_seconds,
            replaced_before_unix=now - replaced_seconds,
        )
        await connection.execute("DELETE FROM replaced_contents WHERE sha256 = ANY(%s)", [list(replaced)])
    if removed.blobs:
        logger.info("%d unused contents of %d bytes were removed", removed.blobs, removed.size_bytes)
    return removed


async def _published(connection: Connection, storage: Storage, entered: set[uuid.UUID]) -> set[str]:
    """Contents of published results that are in no table yet; results of jobs that are gone are withdrawn."""
    found = await asyncio.to_thread(lambda: sorted(storage.documents("results/")))
    jobs = {name: uuid.UUID(match[1]) for name in found if (match := _RESULTS.fullmatch(name))}
    # Asked after the documents were listed: a job is there before its results are.
    cursor = await connection.execute("SELECT id FROM jobs WHERE id = ANY(%s)", [list(set(jobs.values()))])
    known = {row["id"] for row in await cursor.fetchall()}
    named: set[str] = set()
    for name, job_id in jobs.items():
        if job_id not in known:
            await asyncio.to_thread(storage.withdraw, name)
        elif job_id not in entered:
            manifest = await asyncio.to_thread(read_manifest, storage, name)
            named |= {file.sha256 for file in manifest.files} if manifest is not None else set()
    return named
