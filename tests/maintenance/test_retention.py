"""What is old goes when it was told to go, and nothing else; the store loses what nothing names."""

import os
import time
import uuid
from collections.abc import AsyncIterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any, Protocol

import pytest
from psycopg.types.json import Jsonb

from octasplat.workers.db.connections import Connection, Pool, open_pool
from octasplat.workers.db.dataset_checks import begin_check
from octasplat.workers.db.datasets import (
    change_dataset,
    create_dataset,
    get_dataset,
    put_file,
)
from octasplat.workers.db.rows import Job
from octasplat.workers.maintenance.garbage_collection import collect_garbage
from octasplat.workers.maintenance.retention import (
    DeletedCounts,
    Retention,
    apply_retention,
    delete_expired,
    update_expiry_times,
)
from octasplat.workers.queue.attempts import Attempt
from octasplat.workers.queue.claims import claim
from octasplat.workers.queue.job_results import ResultFile
from octasplat.workers.queue.jobs import NewJob, artifacts_of, change_job, create_job, get_job, retry_job
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.storage.trees import Manifest, TreeFile, publish_manifest

DAY, LONG_AGO = 86_400.0, 10 * 86_400.0
KEEP = Retention(jobs_hours=100, jobs_hours_by_kind={"render": 1, "export": 0}, datasets_hours=50)
SLIPS = ProcrastinateQueue()


class ConnectDatabase(Protocol):
    """Opens a pool and takes a connection that commits each statement."""

    def __call__(self) -> AbstractAsyncContextManager[tuple[Pool, Connection]]: ...


@pytest.fixture
def connect_database(conninfo: str) -> ConnectDatabase:
    @asynccontextmanager
    async def connect() -> AsyncIterator[tuple[Pool, Connection]]:
        async with open_pool(conninfo) as pool, pool.connection() as connection:
            await connection.set_autocommit(True)
            yield pool, connection

    return connect


async def finished(connection: Connection, pool: Pool, kind: str = "x", **fields: Any) -> Job:
    job = await create_job(connection, SLIPS, NewJob("me", kind, {}, "cpu", **fields))
    assert job.slip is not None
    attempt = await claim(pool, job.id, job.slip, "w")
    assert attempt is not None
    await attempt.fail({"type": "x", "message": "x"})
    return await existing(connection, job.id)


async def existing(connection: Connection, job_id: uuid.UUID) -> Job:
    job = await get_job(connection, job_id)
    assert job is not None
    return job


async def hours_left(connection: Connection, table: str, row_id: uuid.UUID) -> float | None:
    cursor = await connection.execute(
        f"SELECT extract(epoch FROM expires_at - now())::float8 / 3600 h FROM {table} WHERE id = %s".encode(),
        [row_id],
    )
    row = await cursor.fetchone()
    assert row is not None
    left: float | None = row["h"]
    return left


async def test_retention_per_kind_overrides_default(connect_database: ConnectDatabase) -> None:
    async with connect_database() as (pool, connection):
        plain, render, export = [await finished(connection, pool, k) for k in ("x", "render", "export")]
        pinned = await finished(connection, pool)
        await change_job(connection, pinned.id, label=None, pinned=True)
        queued = await create_job(connection, SLIPS, NewJob("me", "x", {}, "cpu"))
        await update_expiry_times(connection, KEEP)
        assert await hours_left(connection, "jobs", plain.id) == pytest.approx(100, abs=0.1)
        assert await hours_left(connection, "jobs", render.id) == pytest.approx(1, abs=0.1)
        for job in (export, pinned, queued):
            assert await hours_left(connection, "jobs", job.id) is None
        version = (await existing(connection, plain.id)).version
        await update_expiry_times(connection, KEEP)
        assert (await existing(connection, plain.id)).version == version
        assert await delete_expired(connection) == DeletedCounts(0, 0)


async def test_retention_default_keeps_finished_jobs(connect_database: ConnectDatabase) -> None:
    async with connect_database() as (pool, connection):
        job = await finished(connection, pool)
        await connection.execute("UPDATE jobs SET finished_at = now() - interval '9 years'")
        await update_expiry_times(connection, Retention())
        assert await hours_left(connection, "jobs", job.id) is None


async def test_retention_gives_notice_before_expiry(connect_database: ConnectDatabase) -> None:
    async with connect_database() as (pool, connection):
        job = await finished(connection, pool)
        await connection.execute("UPDATE jobs SET finished_at = now() - interval '9 years'")
        await update_expiry_times(connection, KEEP)
        assert await hours_left(connection, "jobs", job.id) == pytest.approx(24, abs=0.1)


async def test_retention_pin_and_retry_clear_expiry(connect_database: ConnectDatabase) -> None:
    async with connect_database() as (pool, connection):
        pinned, retried, left = [await finished(connection, pool) for _ in range(3)]
        await update_expiry_times(connection, KEEP)
        await connection.execute("UPDATE jobs SET expires_at = now() - interval '1 second'")
        assert (await change_job(connection, pinned.id, label=None, pinned=True)).expires_at is None
        await retry_job(connection, SLIPS, retried.id, from_start=False)
        assert await delete_expired(connection) == DeletedCounts(1, 0)
        assert await get_job(connection, left.id) is None
        for job in (pinned, retried):
            assert await get_job(connection, job.id) is not None
        await change_job(connection, pinned.id, label=None, pinned=False)
        await update_expiry_times(connection, KEEP)
        assert (await hours_left(connection, "jobs", pinned.id) or 0) > 1


async def test_source_of_an_unfinished_job_waits(connect_database: ConnectDatabase) -> None:
    async with connect_database() as (pool, connection):
        source = await finished(connection, pool)
        await create_job(connection, SLIPS, NewJob("me", "x", {}, "cpu", source_id=source.id))
        await connection.execute(
            "UPDATE jobs SET expires_at = now() - interval '1 s' WHERE id = %s", [source.id]
        )
        assert await delete_expired(connection) == DeletedCounts(0, 0)
        assert await get_job(connection, source.id) is not None


async def test_datasets_go_when_no_job_needs_them(connect_database: ConnectDatabase) -> None:
    async with connect_database() as (pool, connection):
        used, unused, pinned, fresh = [await create_dataset(connection, "me", "d") for _ in range(4)]
        await connection.execute("UPDATE datasets SET state = 'committed' WHERE id <> %s", [fresh.id])
        await change_dataset(connection, pinned.id, name="d", pinned=True)
        job = await finished(connection, pool, dataset_id=used.id)
        await update_expiry_times(connection, KEEP)
        assert await hours_left(connection, "datasets", unused.id) == pytest.approx(50, abs=0.1)
        for dataset in (used, pinned, fresh):
            assert await hours_left(connection, "datasets", dataset.id) is None
        await connection.execute("DELETE FROM jobs WHERE id = %s", [job.id])
        await update_expiry_times(connection, KEEP)
        assert await hours_left(connection, "datasets", used.id) is not None
        await connection.execute(
            "UPDATE datasets SET expires_at = now() - interval '1 s' WHERE expires_at IS NOT NULL"
        )
        await create_job(connection, SLIPS, NewJob("me", "x", {}, "cpu", dataset_id=used.id))
        assert await delete_expired(connection) == DeletedCounts(0, 1)
        assert await get_dataset(connection, unused.id) is None
        for dataset in (used, pinned, fresh):
            assert await get_dataset(connection, dataset.id) is not None


async def test_retention_running_upload_keeps_open_dataset(connect_database: ConnectDatabase) -> None:
    async with connect_database() as (_pool, connection):
        keep = Retention(open_datasets_hours=10)
        dataset = await create_dataset(connection, "me", "d")
        await connection.execute("UPDATE datasets SET used_at = now() - interval '9 hours'")
        await update_expiry_times(connection, keep)
        await connection.execute("UPDATE datasets SET expires_at = now() + interval '1 hour'")
        await put_file(connection, dataset.id, "images/a.jpg", "a" * 64, 1)
        await update_expiry_times(connection, keep)
        assert await hours_left(connection, "datasets", dataset.id) == pytest.approx(10, abs=0.1)


def put(storage: LocalStorage, content: str, age_seconds: float = LONG_AGO) -> str:
    with storage.open_writer() as writer:
        writer.write(content.encode())
        sha256 = writer.commit().sha256
    path = storage.local_path(sha256)
    assert path is not None
    os.utime(path, (time.time() - age_seconds,) * 2)
    return sha256


def held(storage: LocalStorage) -> set[str]:
    return {entry.blob.sha256 for entry in storage.list_blobs()}


async def running(connection: Connection, pool: Pool) -> Attempt:
    job = await create_job(connection, SLIPS, NewJob("me", "x", {}, "cpu"))
    assert job.slip is not None
    attempt = await claim(pool, job.id, job.slip, "w")
    assert attempt is not None
    return attempt


def checkpoint(*digests: str) -> dict[str, Any]:
    files = [{"path": f"run/{n}", "sha256": d, "size_bytes": 1} for n, d in enumerate(digests)]
    return {"attempt": 1, "stage": "train", "step": 1, "files": files}


async def test_garbage_collection_removes_unreferenced_content_only(
    connect_database: ConnectDatabase, tmp_path: Path
) -> None:
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)

    async with connect_database() as (pool, connection):
        unused, young = put(storage, "unused"), put(storage, "young", age_seconds=DAY / 2)
        photo, result, state, preview = [
            put(storage, name) for name in ("photo", "result", "state", "preview")
        ]
        dataset = await create_dataset(connection, "me", "d")
        await put_file(connection, dataset.id, "images/a.jpg", photo, 5)
        done = await running(connection, pool)
        await done.succeed([ResultFile("scene.ply", result, 6, "x")])
        going = await running(connection, pool)
        await going.record_checkpoint(checkpoint(state), is_progress=True)
        await going.record_preview({"sha256": preview, "step": 1, "view": "a"})
        # Published by an attempt that was lost before it could say so.
        unsaid = put(storage, "unsaid")
        files = (TreeFile(path="scene.ply", sha256=unsaid, size_bytes=6),)
        publish_manifest(storage, f"results/{going.job.id}/1", Manifest(files=files))
        publish_manifest(storage, f"results/{uuid.uuid4()}/1", Manifest(files=files))
        removed = await collect_garbage(pool, storage, unused_seconds=DAY)
        assert removed is not None and (removed.blobs, removed.size_bytes) == (1, 6)
        assert held(storage) == {young, photo, result, state, preview, unsaid} and unused not in held(storage)
        assert list(storage.list_documents("results/")) == [f"results/{going.job.id}/1"]


async def test_replaced_checkpoints_are_deleted_unless_shared(
    connect_database: ConnectDatabase, tmp_path: Path
) -> None:
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)

    async with connect_database() as (pool, connection):
        first, both, second, shared = [
            put(storage, name, age_seconds=3600) for name in ("first", "both", "second", "shared")
        ]
        attempt = await running(connection, pool)
        other = await running(connection, pool)
        await other.succeed([ResultFile("scene.ply", shared, 6, "x")])
        await change_job(connection, other.job.id, label=None, pinned=True)
        await attempt.record_checkpoint(checkpoint(first, both, shared), is_progress=True)
        await attempt.record_checkpoint(checkpoint(both, second), is_progress=True)
        assert (await collect_garbage(pool, storage, unused_seconds=DAY)) is not None
        assert held(storage) == {first, both, second, shared}  # somebody may still read it
        await connection.execute("UPDATE replaced_contents SET replaced_at = now() - interval '1 hour'")
        await collect_garbage(pool, storage, unused_seconds=DAY)
        assert held(storage) == {both, second, shared}
        await attempt.succeed([])
        await connection.execute("UPDATE replaced_contents SET replaced_at = now() - interval '1 hour'")
        await collect_garbage(pool, storage, unused_seconds=DAY)
        assert held(storage) == {shared}
        assert [a.sha256 for a in await artifacts_of(connection, other.job.id)] == [shared]


async def test_garbage_collection_skips_store_of_other_database(
    connect_database: ConnectDatabase, tmp_path: Path
) -> None:
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)

    async with connect_database() as (pool, _):
        unused = put(storage, "unused")
        storage.publish_document("installation", b"another")
        assert await collect_garbage(pool, storage, unused_seconds=DAY) is None
        assert held(storage) == {unused}
        storage.remove_document("installation")
        assert await collect_garbage(pool, storage, unused_seconds=DAY, every_seconds=60) is not None
        put(storage, "unused")
        assert await collect_garbage(pool, storage, unused_seconds=DAY, every_seconds=60) is None
        assert len(held(storage)) == 1


async def test_json_null_checkpoints_do_no_harm(connect_database: ConnectDatabase) -> None:
    async with connect_database() as (pool, connection):
        attempt = await running(connection, pool)
        for value in ({}, {"files": []}, {"stage": "poses"}):
            await connection.execute("UPDATE jobs SET checkpoint = %s", [Jsonb(value)])
        await attempt.cancel()
        cursor = await connection.execute("SELECT count(*) AS n FROM replaced_contents")
        assert (await cursor.fetchone()) == {"n": 0}


async def test_expired_jobs_are_deleted_in_own_transactions(conninfo: str) -> None:
    """As a worker does it: no row is kept locked while the next owner's lock is waited for."""

    async with open_pool(conninfo) as pool:
        async with pool.connection() as connection:
            jobs = [await create_job(connection, SLIPS, NewJob(who, "x", {}, "cpu")) for who in "abcc"]
            checked = await create_dataset(connection, "a", "checked")
            old = [await create_dataset(connection, who, "old") for who in "ab"]
            await begin_check(connection, checked.id)
        for job in jobs:
            assert job.slip is not None
            attempt = await claim(pool, job.id, job.slip, "w")
            assert attempt is not None
            await attempt.fail({"type": "x", "message": "x"})
        async with pool.connection() as connection:
            past = "now() - interval '1 hour'"
            await connection.execute(f"UPDATE jobs SET expires_at = {past}".encode())
            await connection.execute(f"UPDATE datasets SET used_at = {past}".encode())
            query = f"UPDATE datasets SET expires_at = {past} WHERE id = ANY(%s)"
            await connection.execute(query.encode(), [[dataset.id for dataset in old]])
        await apply_retention(pool, KEEP, 1.0)
        async with pool.connection() as connection:
            assert [await get_job(connection, job.id) for job in jobs] == [None] * 4
            assert [await get_dataset(connection, dataset.id) for dataset in old] == [None] * 2
            left = await get_dataset(connection, checked.id)
        assert left is not None and left.state == "open"
