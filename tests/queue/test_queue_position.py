"""An interrupted job keeps its place: it is delivered before all that were queued after it."""

import asyncio
import uuid

from octasplat.workers.db.connections import Pool, open_pool
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.block_jobs import cancel_job
from octasplat.workers.queue.claims import claim
from octasplat.workers.queue.fair_share import queue_position
from octasplat.workers.queue.jobs import NewJob, create_job, get_job, retry_job
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue, requeued_entry_id
from octasplat.workers.queue.recovery import StalledAttempts, recover_stalled_jobs

SLIPS = ProcrastinateQueue(stale_seconds=5)


async def made(pool: Pool, count: int, priority: int = 0) -> list[Job]:
    async with pool.connection() as connection:
        return [
            await create_job(connection, SLIPS, NewJob("me", "toy", {}, "cpu", priority=priority))
            for _ in range(count)
        ]


async def delivered(pool: Pool, count: int) -> list[uuid.UUID]:
    """The jobs of the next ``count`` slips, as a worker gets them."""
    slips, found = ProcrastinateQueue(pool, poll_seconds=0.05), []

    async def deliver(job_id: uuid.UUID, slip: int) -> None:
        attempt = await claim(pool, job_id, slip, "w")
        assert attempt is not None
        await attempt.succeed([])
        found.append(job_id)
        if len(found) == count:
            slips.stop()

    async with asyncio.timeout(60):
        await slips.consume("cpu", 1, deliver)
    return found


async def test_interrupted_jobs_keep_queue_position(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        first, second, third = await made(pool, 3)
        [urgent] = await made(pool, 1, priority=5)
        attempts = []
        for job in (first, second, third):
            assert job.slip is not None
            attempts.append(await claim(pool, job.id, job.slip, "w"))
        tiny = await made(pool, 20)
        # In another order than they were queued in, one of them by the rescue of a lost worker.
        for attempt in (attempts[2], attempts[1]):
            assert attempt is not None
            await attempt.requeue(SLIPS, "its worker is stopping")
        async with pool.connection() as connection:
            await connection.execute(
                "UPDATE jobs SET heartbeat_at = now() - interval '1 minute' WHERE id = %s", [first.id]
            )
        assert await recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(0.0)) == 1
        async with pool.connection() as connection:
            again = await get_job(connection, second.id)
            assert again is not None and await queue_position(connection, again) == 2
            # What was cancelled and is asked for again is a new wish, and goes last.
            await cancel_job(connection, SLIPS, tiny[0].id)
        async with pool.connection() as connection:
            await retry_job(connection, SLIPS, tiny[0].id, from_start=False)
        expected = [urgent, first, second, third, *tiny[1:], tiny[0]]
        assert await delivered(pool, len(expected)) == [job.id for job in expected]


async def test_requeued_job_gets_fresh_entry_ids(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        jobs = await made(pool, 2)
        known = set()
        for _ in range(5):
            for job in jobs[::-1]:
                async with pool.connection() as connection:
                    now = await get_job(connection, job.id)
                assert now is not None and now.slip is not None and now.slip not in known
                known.add(now.slip)
                attempt = await claim(pool, now.id, now.slip, "w")
                assert attempt is not None
                await attempt.requeue(SLIPS, "its worker is stopping")
        async with pool.connection() as connection:  # the slips that were used up
            await connection.execute("DELETE FROM procrastinate_jobs WHERE id NOT IN (SELECT slip FROM jobs)")
        assert await delivered(pool, 2) == [job.id for job in jobs]


def test_requeued_entry_ids_keep_order() -> None:
    slips = [1, 2, 999, 10**15]
    once = [requeued_entry_id(slip) for slip in slips]
    twice = [requeued_entry_id(slip) for slip in once]
    assert once == sorted(once) and twice == sorted(twice) and max(once + twice) < 0
    for early, late in ((once, twice), (twice, once)):
        assert all(a < b for a, b in zip(early, late[1:], strict=False))
    number = once[0]
    for _ in range(10_000):
        assert requeued_entry_id(number) != number
        number = requeued_entry_id(number)
    assert number < once[1]
