"""Jobs and slips are one: written together, fenced, rescued."""

import uuid

import psycopg
import pytest

from octasplat.workers.db.connections import Connection, Pool, open_pool
from octasplat.workers.db.errors import ConflictError, NotFoundError
from octasplat.workers.db.ids import new_id
from octasplat.workers.queue.attempts import FencedError
from octasplat.workers.queue.block_jobs import cancel_job
from octasplat.workers.queue.claims import claim
from octasplat.workers.queue.fair_share import queue_position
from octasplat.workers.queue.job_endings import MAX_SILENT_RECOVERIES
from octasplat.workers.queue.job_results import ResultFile
from octasplat.workers.queue.jobs import (
    NewJob,
    artifacts_of,
    create_job,
    delete_job,
    get_job,
    list_jobs,
    retry_job,
)
from octasplat.workers.queue.protocol import JobQueue
from octasplat.workers.queue.recovery import StalledAttempts, recover_stalled_jobs
from octasplat.workers.queue.usage_figures import worked_seconds
from tests.support.queue_jobs import NEW, SLIPS, claimed, fetched


def count(conninfo: str, table: str) -> int:
    with psycopg.connect(conninfo) as connection:
        row = connection.execute(f"SELECT count(*) FROM {table}".encode()).fetchone()
    assert row is not None
    return int(row[0])


async def test_create_job_rolled_back_leaves_no_rows(conninfo: str) -> None:
    class Regret(Exception):
        pass

    with pytest.raises(Regret):
        async with (
            open_pool(conninfo, max_size=4) as pool,
            pool.connection() as connection,
            connection.transaction(),
        ):
            await create_job(connection, SLIPS, NEW)
            raise Regret
    assert (count(conninfo, "jobs"), count(conninfo, "procrastinate_jobs")) == (0, 0)

    async with open_pool(conninfo, max_size=4) as pool, pool.connection() as connection:
        await create_job(connection, SLIPS, NEW)
    assert (count(conninfo, "jobs"), count(conninfo, "procrastinate_jobs")) == (1, 1)


async def test_claim_with_stale_entry_returns_none(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        attempt = await claimed(pool)
        slip = attempt.job.slip
        assert slip is not None
        assert await claim(pool, attempt.job.id, slip, "other") is None
        await attempt.requeue(SLIPS, "test")
        assert await claim(pool, attempt.job.id, slip, "other") is None
        again = await fetched(pool, attempt.job.id)
        assert again.slip is not None and again.slip != slip and again.state == "queued"
        second = await claim(pool, again.id, again.slip, "other")
        assert second is not None and second.job.attempt == 2
        assert await claim(pool, new_id(), 1, "w") is None


async def test_fenced_attempt_cannot_write(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        ghost = await claimed(pool)
        await ghost.requeue(SLIPS, "test")
        job = await fetched(pool, ghost.job.id)
        assert job.slip is not None
        attempt = await claim(pool, job.id, job.slip, "second")
        assert attempt is not None
        for write in (
            lambda: ghost.heartbeat(),
            lambda: ghost.read_state(),
            lambda: ghost.add_event("x", {}),
            lambda: ghost.add_log_lines(["x"]),
            lambda: ghost.set_progress(stage="train", step=1, total_steps=2),
            lambda: ghost.record_checkpoint({"stage": "train", "step": 9}, is_progress=True),
            lambda: ghost.record_preview({"sha256": "x"}),
            lambda: ghost.succeed([ResultFile("a", "b" * 64, 1, "text/plain")]),
            lambda: ghost.fail({"type": "x", "message": "x"}),
            lambda: ghost.cancel(),
            lambda: ghost.requeue(SLIPS, "x"),
            lambda: ghost.requeue_lost(SLIPS, {"type": "x", "message": "x"}),
        ):
            with pytest.raises(FencedError):
                await write()
        assert (await fetched(pool, job.id)).state == "running"
        await attempt.succeed([ResultFile("a", "b" * 64, 1, "text/plain")])
        with pytest.raises(FencedError):
            await attempt.fail({"type": "x", "message": "x"})
        async with pool.connection() as connection:
            assert [artifact.name for artifact in await artifacts_of(connection, job.id)] == ["a"]


async def test_lost_jobs_are_rescued_three_times_then_failed(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        attempt = await claimed(pool)
        job_id = attempt.job.id
        for rescues in (1, 2, 3):
            assert await recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(0.0)) == 0  # still fresh
            await make_old(pool, job_id)
            assert await recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(0.0)) == 1
            job = await fetched(pool, job_id)
            assert (job.state, job.rescues) == ("queued", rescues) and job.slip is not None
            assert await claim(pool, job_id, job.slip, "w") is not None
        await make_old(pool, job_id)
        await recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(0.0))
        job = await fetched(pool, job_id)
        assert job.state == "failed" and job.error is not None and "4 times" in job.error["message"]
        assert job.slip is None
    assert count(conninfo, "procrastinate_jobs") == 0


async def test_losses_of_another_kind_do_not_count_as_silence(conninfo: str) -> None:
    silent = {"type": "silent", "message": "The program said nothing."}
    async with open_pool(conninfo, max_size=4) as pool:
        job_id = (await claimed(pool)).job.id
        await make_old(pool, job_id)
        await recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(0.0))
        states = []
        for _ in range(2):
            attempt = await claimed(pool, await fetched(pool, job_id))
            await attempt.requeue_lost(SLIPS, silent, max_recoveries=MAX_SILENT_RECOVERIES)
            states.append((await fetched(pool, job_id)).state)
        assert states == ["queued", "failed"]


async def test_new_checkpoint_forgives_lost_workers(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        attempt = await claimed(pool)
        await make_old(pool, attempt.job.id)
        await recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(0.0))
        job = await fetched(pool, attempt.job.id)
        assert job.rescues == 1 and job.slip is not None
        second = await claim(pool, job.id, job.slip, "w")
        assert second is not None
        await second.record_checkpoint({"stage": "train", "step": 5}, is_progress=False)
        assert (await fetched(pool, job.id)).rescues == 1
        await second.record_checkpoint({"stage": "train", "step": 6}, is_progress=True)
        assert (await fetched(pool, job.id)).rescues == 0


async def test_lost_cancelling_job_is_cancelled(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        attempt = await claimed(pool)
        async with pool.connection() as connection:
            await cancel_job(connection, SLIPS, attempt.job.id)
        await make_old(pool, attempt.job.id)
        await recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(0.0))
        assert (await fetched(pool, attempt.job.id)).state == "canceled"


async def test_queued_job_without_entry_is_requeued(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        async with pool.connection() as connection:
            gone, stuck, fine = [await create_job(connection, SLIPS, NEW) for _ in range(3)]
            await connection.execute("UPDATE jobs SET queued_at = now() - interval '1 hour'")
            await connection.execute("DELETE FROM procrastinate_jobs WHERE id = %s", [gone.slip])
            # Fetched by a worker that died before it began; the worker's row is gone as well.
            await connection.execute(
                "UPDATE procrastinate_jobs SET status = 'doing' WHERE id = %s", [stuck.slip]
            )
        await recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(0.0))
        after = [await fetched(pool, job.id) for job in (gone, stuck, fine)]
        assert [job.state for job in after] == ["queued"] * 3
        assert after[0].slip != gone.slip and after[1].slip != stuck.slip and after[2].slip == fine.slip
    assert count(conninfo, "procrastinate_jobs") == 3


async def test_finished_job_state_changes_are_refused(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        attempt = await claimed(pool)
        await attempt.succeed([])
        async with pool.connection() as connection:
            with pytest.raises(ConflictError, match="succeeded"):
                await cancel_job(connection, SLIPS, attempt.job.id)
            with pytest.raises(ConflictError, match="succeeded"):
                await retry_job(connection, SLIPS, attempt.job.id, from_start=False)
            running = await claimed(pool)
            with pytest.raises(ConflictError, match="cancel it first"):
                await delete_job(connection, running.job.id)
            await delete_job(connection, attempt.job.id)
            assert await get_job(connection, attempt.job.id) is None
            with pytest.raises(NotFoundError):
                await cancel_job(connection, SLIPS, attempt.job.id)


async def test_list_pages_and_filters(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool, pool.connection() as connection:
        made = [
            await create_job(connection, SLIPS, NewJob("me", "toy", {}, "cpu", label=f"l{n % 2}"))
            for n in range(6)
        ]
        other = await create_job(connection, SLIPS, NewJob("you", "toy", {}, "cpu"))
        await cancel_job(connection, SLIPS, made[0].id)
        first = await list_jobs(connection, owner="me", limit=4)
        rest = await list_jobs(connection, owner="me", limit=4, before=first[-1].id)
        assert [job.id for job in (*first, *rest)] == [job.id for job in reversed(made)]
        assert [job.id for job in await list_jobs(connection, owner="you")] == [other.id]
        assert len(await list_jobs(connection)) == 7
        assert len(await list_jobs(connection, owner="me", label="l1")) == 3
        assert [j.id for j in await list_jobs(connection, states=["canceled"])] == [made[0].id]
        assert await queue_position(connection, made[1]) == 0
        assert await queue_position(connection, other) == 1  # owners take turns


async def test_time_in_queue_is_no_time_of_work(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        async with pool.connection() as connection:
            made = await create_job(connection, SLIPS, NEW)
        assert made.slip is not None
        attempt = await claim(pool, made.id, made.slip, "w")
        assert attempt is not None
        await attempt.fail({"type": "toy", "message": "It failed."})
        async with pool.connection() as connection:
            await connection.execute("UPDATE jobs SET started_at = now() - interval '4 days'")
        async with pool.connection() as connection:
            await retry_job(connection, SLIPS, made.id, from_start=False)
            job = await cancel_job(connection, SLIPS, made.id)
            assert (job.state, job.started_at) == ("canceled", None)
            assert await worked_seconds(connection, "me") == 0


def test_ids_sort_by_time() -> None:
    ids = [new_id() for _ in range(2000)]
    assert len(set(ids)) == 2000
    assert [i.version for i in ids[:3]] == [7, 7, 7] and ids[0].variant == uuid.RFC_4122
    assert ids == sorted(ids, key=lambda i: i.int >> 64)


def test_procrastinate_queue_implements_protocol() -> None:
    assert isinstance(SLIPS, JobQueue)


async def make_old(pool: Pool, job_id: uuid.UUID) -> None:
    async with pool.connection() as connection:
        await _execute(connection, job_id)


async def _execute(connection: Connection, job_id: uuid.UUID) -> None:
    await connection.execute(
        "UPDATE jobs SET heartbeat_at = now() - interval '1 minute' WHERE id = %s", [job_id]
    )
