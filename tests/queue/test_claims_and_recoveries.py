"""What claiming and recovering a job writes down, and that neither waits for who holds the job."""

import asyncio
import logging
import uuid
from datetime import UTC, datetime, timedelta

import pytest

from octasplat.workers.db.connections import Connection, Pool, open_pool
from octasplat.workers.db.events_and_logs import list_job_events, list_log_lines
from octasplat.workers.db.ids import new_id
from octasplat.workers.db.locks import ROW_SECONDS, try_lock_recovery
from octasplat.workers.db.rows import Job
from octasplat.workers.queue import claims
from octasplat.workers.queue.attempts import Attempt
from octasplat.workers.queue.block_jobs import cancel_job
from octasplat.workers.queue.claims import claim
from octasplat.workers.queue.job_endings import recover_attempt
from octasplat.workers.queue.jobs import get_job
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue
from octasplat.workers.queue.protocol import NewEntry
from octasplat.workers.queue.recovery import StalledAttempts, recover_stalled_jobs
from tests.support.queue_jobs import SLIPS, claimed, fetched

SOON_SECONDS = 5.0
"""What waits for nobody takes less, also on a busy machine."""
LOST = {"type": "worker_lost", "message": "It is gone.", "exit_code": 9}


async def events_of(pool: Pool, job: Job, kind: str) -> list[tuple[int, object]]:
    async with pool.connection() as connection:
        events = await list_job_events(connection, job.id)
    return [(event.attempt, event.data) for event in events if event.kind == kind]


async def log_of(pool: Pool, job: Job) -> list[tuple[int, str]]:
    async with pool.connection() as connection:
        return [(line.attempt, line.text) for line in await list_log_lines(connection, job.id)]


async def turn_of(pool: Pool, job: Job) -> datetime:
    async with pool.connection() as connection:
        cursor = await connection.execute("SELECT turn_at FROM owner_turns WHERE owner = %s", [job.owner])
        row = await cursor.fetchone()
    assert row is not None
    turn: datetime = row["turn_at"]
    return turn


async def entries(pool: Pool) -> set[int]:
    async with pool.connection() as connection:
        cursor = await connection.execute("SELECT id FROM procrastinate_jobs")
        return {row["id"] for row in await cursor.fetchall()}


async def delay_of(pool: Pool, job: Job) -> float:
    async with pool.connection() as connection:
        cursor = await connection.execute(
            "SELECT coalesce(extract(epoch FROM delayed_until - now()), 0) AS s FROM jobs WHERE id = %s",
            [job.id],
        )
        row = await cursor.fetchone()
    assert row is not None
    return float(row["s"])


async def recover(pool: Pool, attempt: Attempt, **options: object) -> bool:
    """Recover an attempt with the error ``LOST``."""
    async with pool.connection() as connection, connection.transaction():
        job = await get_job(connection, attempt.job.id, lock=True)
        assert job is not None
        return await recover_attempt(connection, SLIPS, job, LOST, **options)  # type: ignore[arg-type]


async def idle_limit(connection: Connection) -> float:
    """Return for how many seconds the transaction may be idle; 0 is without end."""
    cursor = await connection.execute(
        "SELECT extract(epoch FROM current_setting('idle_in_transaction_session_timeout')::interval) AS s"
    )
    row = await cursor.fetchone()
    assert row is not None
    return float(row["s"])


async def make_old(pool: Pool, job: Job) -> None:
    async with pool.connection() as connection:
        await connection.execute(
            "UPDATE jobs SET heartbeat_at = now() - interval '1 hour' WHERE id = %s", [job.id]
        )


async def test_claim_begins_an_attempt_anew(conninfo: str, monkeypatch: pytest.MonkeyPatch) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        first = await claimed(pool)
        job = first.job
        assert job.started_at is not None and job.heartbeat_at is not None
        assert datetime.now(UTC) - job.started_at < timedelta(minutes=1)
        assert await events_of(pool, job, "state") == [
            (0, {"state": "queued"}), (1, {"state": "running", "worker": "w"}),
        ]  # fmt: skip
        assert await log_of(pool, job) == [(1, "Attempt 1")]
        first_turn = await turn_of(pool, job)
        await first.set_progress(stage="train", step=3, total_steps=9, seconds_left=5.0)
        await first.add_log_lines(["a", "b", "c"])
        await first.requeue(SLIPS, "test")
        monkeypatch.setattr(claims, "MAX_EARLIER_LOG_LINES", 2)
        again = await fetched(pool, job.id)
        assert again.slip is not None
        second = await claim(pool, job.id, again.slip, "other")
        assert second is not None
        begun = second.job
        assert (begun.state, begun.attempt, begun.worker) == ("running", 2, "other")
        assert begun.started_at is not None and begun.started_at > job.started_at
        assert begun.heartbeat_at is not None and begun.heartbeat_at > job.heartbeat_at
        assert (begun.stage, begun.step, begun.total_steps, begun.seconds_left) == (None,) * 4
        assert (await events_of(pool, job, "state"))[-1] == (2, {"state": "running", "worker": "other"})
        lines = await log_of(pool, job)
        assert lines[0] == (1, "c") and lines[-1] == (2, "Attempt 2") and len(lines) == 3
        assert await turn_of(pool, job) > first_turn


async def test_recovery_passes_over_jobs_that_others_hold(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        held, free = await claimed(pool), await claimed(pool)
        for attempt in (held, free):
            await make_old(pool, attempt.job)
        async with pool.connection() as other, other.transaction():
            assert await get_job(other, held.job.id, lock=True) is not None
            async with asyncio.timeout(SOON_SECONDS):
                assert await recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(0.0)) == 1
        assert [(await fetched(pool, a.job.id)).state for a in (held, free)] == ["running", "queued"]


async def test_jobs_are_read_without_their_locks(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        job = (await claimed(pool)).job
        async with pool.connection() as other, other.transaction(), asyncio.timeout(SOON_SECONDS):
            usual = await idle_limit(other)
            assert await get_job(other, job.id) == await fetched(pool, job.id)
            assert await idle_limit(other) == usual != ROW_SECONDS
            assert await get_job(other, job.id, lock=True) == await fetched(pool, job.id)
            assert await idle_limit(other) == ROW_SECONDS


async def test_recovery_is_bounded_in_time(conninfo: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its host may vanish while it holds the locks of jobs."""
    limits: list[float] = []
    async with open_pool(conninfo, max_size=4) as pool:
        attempt = await claimed(pool)
        await make_old(pool, attempt.job)
        enqueue = ProcrastinateQueue.enqueue

        async def note_limit(queue: ProcrastinateQueue, connection: Connection, entry: NewEntry) -> int:
            limits.append(await idle_limit(connection))
            return await enqueue(queue, connection, entry)

        monkeypatch.setattr(ProcrastinateQueue, "enqueue", note_limit)
        assert await recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(0.0)) == 1
    assert limits == [ROW_SECONDS]


async def test_recovery_names_the_lost_worker_in_the_log_alone(
    conninfo: str, caplog: pytest.LogCaptureFixture
) -> None:
    """It has the name of its host, which the owner of the job is not told."""
    caplog.set_level(logging.WARNING, "octasplat.workers.queue.recovery")
    async with open_pool(conninfo, max_size=4) as pool:
        attempt = await claimed(pool)
        async with pool.connection() as connection:
            await connection.execute("UPDATE jobs SET rescues = 3")
        await make_old(pool, attempt.job)
        assert await recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(0.0)) == 1
        job = await fetched(pool, attempt.job.id)
        assert job.error is not None and job.error["type"] == "worker_lost" and job.error["rescues"] == 3
        assert job.error["message"].startswith("Its worker was not heard of for 5 s: ")
        assert [record.message for record in caplog.records] == [f"worker w was lost with job {job.id}"]


async def test_recovery_logs_entries_that_were_lost(conninfo: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "octasplat.workers.queue.recovery")
    async with open_pool(conninfo, max_size=4) as pool:
        attempt = await claimed(pool)
        await attempt.requeue(SLIPS, "test")
        async with pool.connection() as connection:
            await connection.execute("UPDATE jobs SET queued_at = now() - interval '1 hour'")
            await connection.execute("DELETE FROM procrastinate_jobs")
        assert await recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(0.0)) == 0
        assert [record.message for record in caplog.records] == [
            f"job {attempt.job.id} had no entry in the queue and got a new one"
        ]


async def test_job_without_an_entry_for_a_moment_is_left_to_its_worker(conninfo: str) -> None:
    stalled = StalledAttempts(0.3)
    async with open_pool(conninfo, max_size=4) as pool:
        job = (await claimed(pool)).job
        async with pool.connection() as connection:
            await connection.execute(
                "UPDATE jobs SET state = 'queued', queued_at = now() - interval '1 hour'"
            )
            await connection.execute("DELETE FROM procrastinate_jobs")
        await recover_stalled_jobs(pool, SLIPS, 5, stalled)
        assert (await fetched(pool, job.id)).slip == job.slip
        await asyncio.sleep(0.4)
        await recover_stalled_jobs(pool, SLIPS, 5, stalled)
        assert (await fetched(pool, job.id)).slip != job.slip


async def test_one_process_recovers_at_a_time(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        attempt = await claimed(pool)
        async with pool.connection() as connection:
            await connection.execute("UPDATE jobs SET heartbeat_at = now() - interval '1 hour'")
        async with pool.connection() as other:
            async with other.transaction():
                assert await try_lock_recovery(other)
                assert await recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(0.0)) == 0
            assert await recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(0.0)) == 1
        assert (await fetched(pool, attempt.job.id)).state == "queued"


async def test_recovery_leaves_jobs_alone_that_went_on(
    conninfo: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They had no entry when it looked, and are over, canceled or claimed when it has their locks."""
    async with open_pool(conninfo, max_size=4) as pool:
        running, canceled = await claimed(pool), await claimed(pool)
        await canceled.requeue(SLIPS, "test")

        async def orphaned(_queue: ProcrastinateQueue, _connection: Connection) -> list[uuid.UUID]:
            return [running.job.id, new_id(), canceled.job.id]

        monkeypatch.setattr(ProcrastinateQueue, "orphaned_jobs", orphaned)
        async with pool.connection() as other, other.transaction():
            assert await get_job(other, canceled.job.id, lock=True) is not None
            recovery = asyncio.create_task(recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(0.0)))
            await asyncio.sleep(0.3)
            await other.execute("UPDATE jobs SET state = 'canceled' WHERE id = %s", [canceled.job.id])
        assert await asyncio.wait_for(recovery, SOON_SECONDS) == 0
        jobs = [await fetched(pool, attempt.job.id) for attempt in (running, canceled)]
        assert [job.state for job in jobs] == ["running", "canceled"]
        assert jobs[0].slip == running.job.slip


async def test_attempts_are_stalled_only_while_they_do_not_change(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        job = (await claimed(pool)).job
    stalled = StalledAttempts(0.2)
    assert stalled.confirm([job]) == []
    await asyncio.sleep(0.25)
    assert stalled.confirm([job]) == [job]
    assert stalled.confirm([]) == []
    assert stalled.confirm([job]) == []  # found anew


async def test_recovered_attempt_is_written_down(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        attempt, other = await claimed(pool), await claimed(pool)
        assert await recover(pool, attempt, delay_seconds=3600.0) is False
        assert (await fetched(pool, other.job.id)).rescues == 0
        job = await fetched(pool, attempt.job.id)
        assert (job.state, job.rescues, job.attempt) == ("queued", 1, 1)
        assert job.slip is not None and job.slip != attempt.job.slip
        assert await events_of(pool, job, "rescued") == [
            (1, {"type": "worker_lost", "reason": "It is gone.", "rescues": 1})
        ]
        assert (1, "Lost, and queued again: It is gone.") in await log_of(pool, job)
        assert job.waits_for == "It is gone."
        assert 3000 < await delay_of(pool, job) <= 3600
        assert await entries(pool) == {job.slip, other.job.slip}


async def test_recovered_attempt_keeps_an_entry_under_delivery(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        attempt = await claimed(pool)
        assert not await recover(pool, attempt, keep_entry=True)
        job = await fetched(pool, attempt.job.id)
        assert await entries(pool) == {attempt.job.slip, job.slip}
        assert await delay_of(pool, job) == 0


async def test_attempt_that_was_lost_too_often_fails_its_job(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        attempt = await claimed(pool)
        assert await recover(pool, attempt, max_recoveries=0)
        job = await fetched(pool, attempt.job.id)
        message = "It is gone. This happened 1 times without getting any further."
        assert (job.state, job.error) == ("failed", {**LOST, "message": message, "rescues": 0})
        assert await events_of(pool, job, "rescued") == []
        assert await entries(pool) == set()


async def test_attempt_at_a_canceled_job_that_is_lost_ends_it(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        attempt = await claimed(pool)
        async with pool.connection() as connection:
            await cancel_job(connection, SLIPS, attempt.job.id)
        assert not await recover(pool, attempt, max_recoveries=0)
        job = await fetched(pool, attempt.job.id)
        assert (job.state, job.error) == ("canceled", None)
        assert await entries(pool) == set()


async def test_entry_under_delivery_stays_when_its_job_fails(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        attempt = await claimed(pool)
        assert await recover(pool, attempt, max_recoveries=0, keep_entry=True)
        assert await entries(pool) == {attempt.job.slip}
