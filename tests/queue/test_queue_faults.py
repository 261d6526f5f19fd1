"""One job's trouble, or that of the machine around it, stays where it is."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import psycopg
import pytest

from octasplat.workers.db.connections import Connection, open_pool, retry_on_deadlock
from octasplat.workers.db.dataset_checks import begin_check, end_check, renew_check, reopen_stale_checks
from octasplat.workers.db.datasets import (
    create_dataset,
    get_dataset,
    put_file,
)
from octasplat.workers.db.events_and_logs import list_job_events, list_log_lines
from octasplat.workers.db.locks import lock_owner, lock_store
from octasplat.workers.maintenance.webhooks.rows import add_endpoint, delete_endpoint
from octasplat.workers.queue.attempts import FencedError
from octasplat.workers.queue.block_jobs import cancel_job
from octasplat.workers.queue.claims import claim
from octasplat.workers.queue.job_results import ResultFile
from octasplat.workers.queue.jobs import change_job, create_job, get_job
from octasplat.workers.queue.recovery import StalledAttempts, recover_stalled_jobs
from octasplat.workers.queue.storage_leases import (
    mark_for_removal,
    removal_transaction,
    storage_lease,
    unmark_for_removal,
)
from octasplat.workers.storage.errors import StorageUnavailableError
from octasplat.workers.storage.local import LocalStorage
from tests.support.queue_jobs import NEW, SLIPS, claimed, fetched

SOON_SECONDS = 5.0
"""What waits for nobody takes less, also on a busy machine."""


async def test_job_events_with_invalid_text_are_stored(conninfo: str) -> None:
    odd = "header \0 and \ud800"

    async with open_pool(conninfo, max_size=6) as pool:
        attempt = await claimed(pool)
        await attempt.add_event("warning", {"message": odd, "value": float("nan")})
        await attempt.add_log_lines([odd])
        await attempt.record_checkpoint({"stage": odd, "step": 1, "files": []}, is_progress=True)
        await attempt.fail({"type": "odd", "message": odd})
        job = await fetched(pool, attempt.job.id)
        assert job.state == "failed" and job.error is not None
        assert job.error["message"] == "header \ufffd and \ufffd"
        async with pool.connection() as connection:
            told = {event.kind: event.data for event in await list_job_events(connection, job.id)}
            lines = [line.text for line in await list_log_lines(connection, job.id)]
        assert told["warning"] == {"message": "header \ufffd and \ufffd", "value": None}
        assert "header \ufffd and \ufffd" in lines


async def test_job_with_repeated_worker_failures_fails(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        attempt = await claimed(pool)
        rescues = []
        while (job := await fetched(pool, attempt.job.id)).state != "failed":
            attempt = attempt if job.state == "running" else await claimed(pool, job)
            if len(rescues) == 2:
                await attempt.requeue(SLIPS, "its worker is stopping", max_uncounted=3)
                attempt = await claimed(pool, await fetched(pool, attempt.job.id))
            await attempt.requeue(SLIPS, "its worker failed (KeyError)", max_uncounted=3)
            rescues.append((await fetched(pool, attempt.job.id)).rescues)
        assert rescues == [0, 0, 0, 1, 2, 3, 3]
        assert job.error is not None and job.error["type"] == "worker_failed"
        assert "its worker failed (KeyError)" in job.error["message"]


async def test_checkpoint_resets_worker_failures(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        attempt = await claimed(pool)
        for step in range(8):
            await attempt.record_checkpoint({"stage": "x", "step": step, "files": []}, is_progress=True)
            await attempt.requeue(SLIPS, "its worker failed (KeyError)", max_uncounted=3)
            job = await fetched(pool, attempt.job.id)
            assert job.rescues == 0
            attempt = await claimed(pool, job)


@pytest.mark.parametrize("hours", [-1, 1], ids=["clock-jumped-ahead", "clock-set-back"])
async def test_lost_worker_is_detected_and_live_one_kept_after_clock_changed(
    conninfo: str, hours: int
) -> None:
    """Heartbeats look older or newer than they are."""
    async with open_pool(conninfo, max_size=6) as pool:
        living, lost = await claimed(pool), await claimed(pool)
        async with pool.connection() as connection:
            await connection.execute(
                "UPDATE jobs SET heartbeat_at = heartbeat_at + make_interval(hours => %s)", [hours]
            )
        suspects = StalledAttempts(0.3)
        assert await recover_stalled_jobs(pool, SLIPS, 5, suspects) == 0
        await living.heartbeat()
        await asyncio.sleep(0.4)
        assert await recover_stalled_jobs(pool, SLIPS, 5, suspects) == 1
        assert [(await fetched(pool, a.job.id)).state for a in (living, lost)] == ["running", "queued"]


@pytest.mark.parametrize("lock", ["owner", "store"])
async def test_heartbeat_is_not_blocked_by_other_locks(conninfo: str, tmp_path: Path, lock: str) -> None:
    """An owner's archive is being entered, or unused contents are being marked, for a long time."""
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)
    with storage.open_writer() as writer:
        writer.write(b"x")
        blob = writer.commit()
    manifest = {"stage": "x", "step": 1, "files": [{"path": "a", "sha256": blob.sha256, "size_bytes": 1}]}

    async with open_pool(conninfo, max_size=6) as pool:
        attempt = await claimed(pool)
        async with storage_lease(pool, storage) as note, pool.connection() as connection:
            if lock == "owner":
                await lock_owner(connection, "me")
            else:
                await lock_store(connection, shared=False)
            keeping = asyncio.create_task(attempt.record_checkpoint(manifest, is_progress=True, lease=note))
            ending = asyncio.create_task(
                attempt.fail({"type": "x", "message": "x"}, [ResultFile("a", blob.sha256, 1, "")], note)
            )
            await asyncio.sleep(0.5)
            assert not keeping.done() and not ending.done()
            async with asyncio.timeout(SOON_SECONDS):
                assert await attempt.heartbeat() == "running"
            await connection.rollback()
            kept, ended = await asyncio.gather(keeping, ending, return_exceptions=True)
        assert kept is None or isinstance(kept, FencedError)  # they went on in either order
        assert not isinstance(ended, BaseException)
        assert (await fetched(pool, attempt.job.id)).state == "failed"


async def test_contents_being_removed_are_awaited_without_lock(conninfo: str, tmp_path: Path) -> None:
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)

    def stored(content: bytes) -> str:
        with storage.open_writer() as writer:
            writer.write(content)
            return writer.commit().sha256

    async with open_pool(conninfo, max_size=6) as pool:
        attempt = await claimed(pool)
        async with storage_lease(pool, storage) as note, pool.connection() as connection:
            kept, gone = stored(b"kept"), stored(b"gone")
            async with removal_transaction(connection):
                await mark_for_removal(connection, [kept, gone])
            tellings = [
                asyncio.create_task(attempt.record_preview({"sha256": sha256, "step": 1, "view": "a"}, note))
                for sha256 in (kept, gone)
            ]
            await asyncio.sleep(0.5)
            assert not any(telling.done() for telling in tellings)
            async with asyncio.timeout(SOON_SECONDS):
                await attempt.heartbeat()
            storage.delete(gone)
            async with connection.transaction():
                await unmark_for_removal(connection, [kept, gone])
            await tellings[0]
            with pytest.raises(StorageUnavailableError, match="removed meanwhile"):
                await tellings[1]


async def test_webhook_deletion_during_job_end_succeeds(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        attempt = await claimed(pool)
        async with pool.connection() as connection:
            hook = await add_endpoint(
                connection, owner="me", url="https://example.org", secret="s", events=["job.failed"]
            )
        async with pool.connection() as connection:
            await delete_endpoint(connection, hook.id)
            ending = asyncio.create_task(attempt.fail({"type": "x", "message": "x"}))
            await asyncio.sleep(0.5)
            assert not ending.done()
            await connection.commit()
            await ending
        assert (await fetched(pool, attempt.job.id)).state == "failed"


async def test_transaction_after_deadlock_is_retried(conninfo: str) -> None:
    """Two that lock the same rows in different orders; the database ends one of them."""

    async with open_pool(conninfo, max_size=6) as pool:
        ids = [(await claimed(pool)).job.id for _ in range(2)]
        both = asyncio.Barrier(2)
        tries = 0

        @retry_on_deadlock
        async def lock(first: int, second: int) -> None:
            nonlocal tries
            tries += 1
            async with pool.connection() as connection, connection.transaction():
                await get_job(connection, ids[first], lock=True)
                if tries <= 2:
                    await both.wait()
                await get_job(connection, ids[second], lock=True)

        await asyncio.gather(lock(0, 1), lock(1, 0))
        assert tries == 3


async def test_lock_order_is_checked(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        attempt = await claimed(pool)
        for lock in (lambda c: lock_owner(c, "me"), lambda c: lock_store(c, shared=True)):
            with pytest.raises(psycopg.errors.RaiseException, match="order of locks"):
                async with pool.connection() as connection:
                    await get_job(connection, attempt.job.id, lock=True)
                    await lock(connection)
        with pytest.raises(psycopg.errors.RaiseException, match="order of locks"):
            async with pool.connection() as connection:
                await lock_owner(connection, "me")
                await lock_store(connection, shared=False)


async def test_jobs_are_locked_before_datasets(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        attempt = await claimed(pool)
        job_id = attempt.job.id
        async with pool.connection() as connection:
            dataset = await create_dataset(connection, "me", "d")
        takes: tuple[Callable[[Connection], Awaitable[object]], ...] = (
            lambda c: get_job(c, job_id, lock=True),
            lambda c: c.execute("UPDATE jobs SET label = 'x' WHERE id = %s", [job_id]),
            lambda c: change_job(c, job_id, label="y", pinned=False),
        )
        for take in takes:
            with pytest.raises(psycopg.errors.RaiseException, match="order of locks: rows of jobs"):
                async with pool.connection() as connection:
                    await get_dataset(connection, dataset.id, lock=True)
                    await take(connection)
        async with pool.connection() as connection:
            await get_job(connection, job_id, lock=True)
            await get_dataset(connection, dataset.id, lock=True)
            await connection.execute("UPDATE jobs SET label = 'x' WHERE id = %s", [job_id])


async def test_stale_dataset_check_is_reopened(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        async with pool.connection() as connection:
            ids = [(await create_dataset(connection, "me", "d")).id for _ in range(2)]
            for dataset_id in ids:
                await begin_check(connection, dataset_id)
            query = "UPDATE datasets SET used_at = now() - interval '10 minutes' WHERE id = %s"
            await connection.execute(query, [ids[0]])
            assert await reopen_stale_checks(connection) == 1
            found = [await get_dataset(connection, dataset_id) for dataset_id in ids]
        assert [dataset.state for dataset in found if dataset] == ["open", "checking"]


async def test_stale_storage_check_keeps_later_files(conninfo: str) -> None:
    """Its process was frozen; meanwhile the dataset was opened, changed, and is being checked again."""

    async with open_pool(conninfo, max_size=6) as pool:
        async with pool.connection() as connection:
            dataset_id = (await create_dataset(connection, "me", "d")).id
        async with pool.connection() as connection:
            frozen = await begin_check(connection, dataset_id)
            await renew_check(connection, frozen)
            await connection.execute("UPDATE datasets SET used_at = now() - interval '10 minutes'")
            assert await reopen_stale_checks(connection) == 1
        async with pool.connection() as connection:
            await put_file(connection, dataset_id, "images/a.jpg", "b" * 64, 2)
            later = await begin_check(connection, dataset_id)
        async with pool.connection() as connection:
            await renew_check(connection, frozen)
            dataset = await end_check(connection, frozen, is_valid=True, photographs=1)
            assert dataset.state == "checking" and dataset.photographs == 0
            await renew_check(connection, later)
            dataset = await end_check(connection, later, is_valid=True, photographs=2)
            assert dataset.state == "committed" and dataset.photographs == 2


async def test_write_that_meets_a_recovery_waits_and_is_fenced(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        ghost = await claimed(pool)
        async with pool.connection() as other, other.transaction():
            job = await get_job(other, ghost.job.id, lock=True)
            assert job is not None
            await other.execute("UPDATE jobs SET attempt = attempt + 1 WHERE id = %s", [job.id])
            late = asyncio.create_task(ghost.add_log_lines(["late"]))
            await asyncio.sleep(0.3)
            assert not late.done()
        with pytest.raises(FencedError):
            await asyncio.wait_for(late, SOON_SECONDS)
        async with pool.connection() as connection:
            lines = await list_log_lines(connection, ghost.job.id)
        assert "late" not in str(lines)


async def test_entry_that_is_claimed_twice_at_once_begins_one_attempt(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        async with pool.connection() as connection:
            job = await create_job(connection, SLIPS, NEW)
        assert job.slip is not None
        async with pool.connection() as other, other.transaction():
            assert await get_job(other, job.id, lock=True) is not None
            both = [asyncio.create_task(claim(pool, job.id, job.slip, name)) for name in ("a", "b")]
            await asyncio.sleep(0.3)
        attempts = [attempt for attempt in await asyncio.gather(*both) if attempt is not None]
        assert [attempt.job.attempt for attempt in attempts] == [1]


async def test_attempt_at_a_job_that_is_being_canceled_still_writes(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        attempt = await claimed(pool)
        async with pool.connection() as connection:
            await cancel_job(connection, SLIPS, attempt.job.id)
        assert await attempt.heartbeat() == await attempt.read_state() == "canceling"
        await attempt.cancel()
        assert (await fetched(pool, attempt.job.id)).state == "canceled"
        with pytest.raises(FencedError):
            await attempt.heartbeat()
