"""What is stored under a lease is named only if it is there, and nothing goes that is being named."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from octasplat.workers.db.connections import Connection, Pool, open_pool
from octasplat.workers.queue import storage_leases
from octasplat.workers.queue.storage_leases import (
    StorageLease,
    expire_stale_leases,
    mark_for_removal,
    removal_transaction,
    storage_lease,
    unmark_for_removal,
)
from octasplat.workers.storage.errors import StorageUnavailableError
from octasplat.workers.storage.local import LocalStorage

SOON_SECONDS = 5.0
"""What waits for nobody takes less, also on a busy machine."""
ABSENT = "a" * 64


@pytest.fixture
def storage(tmp_path: Path) -> LocalStorage:
    return LocalStorage(tmp_path / "store", floor_bytes=0)


@pytest.fixture(autouse=True)
def bounded_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage_leases, "MAX_WAIT_SECONDS", SOON_SECONDS)


def stored(storage: LocalStorage, content: bytes = b"x") -> str:
    with storage.open_writer() as writer:
        writer.write(content)
        return writer.commit().sha256


async def mark(pool: Pool, *contents: str) -> None:
    async with pool.connection() as connection, removal_transaction(connection):
        await mark_for_removal(connection, contents)


async def unmark(pool: Pool, *contents: str) -> None:
    async with pool.connection() as connection:
        await unmark_for_removal(connection, contents)


def renewals() -> int:
    """Return how many leases are being renewed."""
    return sum("_renew" in repr(task.get_coro()) for task in asyncio.all_tasks())


async def make_old(pool: Pool, lease: StorageLease) -> None:
    async with pool.connection() as connection:
        await connection.execute(
            "UPDATE storing SET seen_at = seen_at - interval '1 hour' WHERE id = %s", [lease.id]
        )


async def expire(pool: Pool) -> None:
    async with pool.connection() as connection:
        await expire_stale_leases(connection)


@asynccontextmanager
async def lent(conninfo: str, storage: LocalStorage) -> AsyncIterator[tuple[Pool, StorageLease]]:
    async with open_pool(conninfo, max_size=5) as pool, storage_lease(pool, storage) as lease:
        yield pool, lease


async def test_lease_that_expired_names_nothing(conninfo: str, storage: LocalStorage) -> None:
    async with lent(conninfo, storage) as (pool, lease), storage_lease(pool, storage) as other:
        content = stored(storage)
        await expire(pool)
        assert await lease.verify([content]) == lease.removals  # it was fresh
        async with lease.reference([content]) as connection:
            await connection.execute("SELECT 1")
        await make_old(pool, lease)
        await expire(pool)
        for names in (lambda: lease.verify([content]), lambda: lease.reference([content]).__aenter__()):
            with pytest.raises(StorageUnavailableError, match="silent for too long"):
                await names()
        await other.verify([content])


async def test_lease_that_expires_behind_the_look_names_nothing(
    conninfo: str, storage: LocalStorage, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with lent(conninfo, storage) as (pool, lease):
        content, lock_store = stored(storage), storage_leases.lock_store

        async def expire_and_lock(connection: Connection, *, shared: bool) -> None:
            await make_old(pool, lease)
            await expire(pool)
            await lock_store(connection, shared=shared)

        monkeypatch.setattr(storage_leases, "lock_store", expire_and_lock)
        with pytest.raises(StorageUnavailableError, match="silent for too long"):
            await lease.reference([content]).__aenter__()


async def test_contents_that_are_being_removed_are_waited_for(conninfo: str, storage: LocalStorage) -> None:
    async with lent(conninfo, storage) as (pool, lease):
        kept, gone = stored(storage), stored(storage, b"gone")
        await mark(pool, gone, kept)
        both = [asyncio.create_task(lease.verify([content])) for content in (kept, gone)]
        await asyncio.sleep(0.5)
        assert not any(task.done() for task in both)
        storage.delete(gone)
        await unmark(pool, gone, kept)
        async with asyncio.timeout(SOON_SECONDS):
            assert lease.removals is not None and await both[0] == lease.removals + 1
            with pytest.raises(StorageUnavailableError, match=r"^1 contents were removed"):
                await both[1]


async def test_removal_of_other_contents_is_not_waited_for(conninfo: str, storage: LocalStorage) -> None:
    async with lent(conninfo, storage) as (pool, lease):
        content = stored(storage)
        await mark(pool, ABSENT)
        async with asyncio.timeout(SOON_SECONDS):
            assert lease.removals is not None and await lease.verify([content]) == lease.removals + 1


async def test_wait_for_a_removal_is_bounded(
    conninfo: str, storage: LocalStorage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(storage_leases, "MAX_WAIT_SECONDS", 0.5)
    monkeypatch.setattr(storage_leases, "_POLL_SECONDS", 0.1)
    looks: list[object] = []
    are_being_removed = storage_leases._are_being_removed

    async def look(connection: Connection, contents: list[str] | None) -> bool:
        looks.append(contents)
        return await are_being_removed(connection, contents)

    monkeypatch.setattr(storage_leases, "_are_being_removed", look)
    async with lent(conninfo, storage) as (pool, lease):
        content = stored(storage)
        await mark(pool, content)
        async with asyncio.timeout(SOON_SECONDS):
            with pytest.raises(StorageUnavailableError, match="are being removed"):
                await lease.verify([content])
    assert 2 <= len(looks) <= 8, "it looks at intervals"


async def test_mark_of_a_lost_process_counts_for_a_while(conninfo: str, storage: LocalStorage) -> None:
    async with lent(conninfo, storage) as (pool, lease):
        content = stored(storage)
        await mark(pool, content)
        async with pool.connection() as connection:
            await connection.execute("UPDATE removing_contents SET since = since - interval '1 hour'")
        async with asyncio.timeout(SOON_SECONDS):
            await lease.verify([content])
        await mark(pool, content, ABSENT)  # it counts from now on
        await unmark(pool, ABSENT)
        waiting = asyncio.create_task(lease.verify([content]))
        await asyncio.sleep(0.5)
        assert not waiting.done()
        await unmark(pool, content)
        await asyncio.wait_for(waiting, SOON_SECONDS)


async def test_lease_that_began_during_a_removal_looks_for_its_contents(
    conninfo: str, storage: LocalStorage
) -> None:
    async with open_pool(conninfo, max_size=5) as pool:
        await mark(pool, ABSENT)
        async with storage_lease(pool, storage) as lease:
            assert lease.removals is None
            await unmark(pool, ABSENT)
            with pytest.raises(StorageUnavailableError, match=r"^1 contents were removed"):
                await lease.verify([ABSENT])
        async with storage_lease(pool, storage) as quiet:
            assert quiet.removals is not None
            await quiet.verify([ABSENT])  # nothing was marked since, so that nobody looks


async def test_lease_that_begins_while_removals_are_marked_counts_none(
    conninfo: str, storage: LocalStorage
) -> None:
    async with (
        open_pool(conninfo, max_size=5) as pool,
        pool.connection() as connection,
        removal_transaction(connection),
        asyncio.timeout(SOON_SECONDS),
        storage_lease(pool, storage) as lease,
    ):
        assert lease.removals is None


async def test_contents_marked_behind_the_look_are_looked_at_again(
    conninfo: str, storage: LocalStorage, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with lent(conninfo, storage) as (pool, lease):
        content, lock_store = stored(storage), storage_leases.lock_store
        is_first = True

        async def mark_and_lock(connection: Connection, *, shared: bool) -> None:
            nonlocal is_first
            if is_first and shared:
                is_first = False
                await mark(pool, content)
                storage.delete(content)
                await unmark(pool, content)
            await lock_store(connection, shared=shared)

        monkeypatch.setattr(storage_leases, "lock_store", mark_and_lock)
        with pytest.raises(StorageUnavailableError, match=r"^1 contents were removed"):
            await lease.reference([content]).__aenter__()


async def test_nothing_is_marked_while_contents_are_named(conninfo: str, storage: LocalStorage) -> None:
    async with lent(conninfo, storage) as (pool, lease):
        content = stored(storage)
        async with lease.reference([content]):
            async with asyncio.timeout(SOON_SECONDS), lease.reference([content]):  # others name theirs
                removal = asyncio.create_task(mark(pool, ABSENT))
                await asyncio.sleep(0.3)
            assert not removal.done()
        await asyncio.wait_for(removal, SOON_SECONDS)


async def test_look_does_not_wait_for_a_lease_that_is_about_to_end(
    conninfo: str, storage: LocalStorage
) -> None:
    async with lent(conninfo, storage) as (pool, lease):
        content = stored(storage)
        async with pool.connection() as other, other.transaction():
            await other.execute("DELETE FROM storing WHERE id = %s", [lease.id])
            async with asyncio.timeout(SOON_SECONDS):
                await lease.verify([content])
        with pytest.raises(StorageUnavailableError, match="silent for too long"):
            await lease.verify([content])


async def test_lease_that_is_confirmed_does_not_expire(conninfo: str, storage: LocalStorage) -> None:
    async with lent(conninfo, storage) as (pool, lease):
        content = stored(storage)
        await make_old(pool, lease)
        async with lease.reference([content]), asyncio.timeout(SOON_SECONDS):
            await expire(pool)
        await lease.verify([content])


async def test_leases_end_with_their_block(conninfo: str, storage: LocalStorage) -> None:
    async with open_pool(conninfo, max_size=5) as pool:
        async with storage_lease(pool, storage) as lease, storage_lease(pool, storage) as other:
            assert lease.id != other.id
            await asyncio.sleep(0.1)
            assert renewals() == 2
        with pytest.raises(StorageUnavailableError):
            await lease.verify([])
        assert renewals() == 0
