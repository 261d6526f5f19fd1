"""A job in a queue that no worker takes does not wait for ever."""

import asyncio
from functools import partial

from octasplat.workers.db.connections import open_pool
from octasplat.workers.db.holds import set_queue_paused
from octasplat.workers.db.ids import new_id
from octasplat.workers.db.workers import record_worker_heartbeat
from octasplat.workers.queue.claims import claim
from octasplat.workers.queue.job_deadlines import fail_abandoned_jobs
from octasplat.workers.queue.jobs import NewJob, create_job, get_job
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue
from octasplat.workers.queue.recovery import StalledAttempts

SLIPS = ProcrastinateQueue(stale_seconds=5)


async def test_jobs_in_unserved_queues_fail_after_timeout(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:

        async def give_up(hours: float = 1) -> list[str]:
            ended = await fail_abandoned_jobs(
                pool, SLIPS, stale_seconds=20, hours=hours, suspects=StalledAttempts(0)
            )
            return [name for name, job in jobs.items() if job.id in ended]

        async with pool.connection() as connection:
            jobs = {
                name: await create_job(connection, SLIPS, NewJob("me", "toy", {}, queue))
                for name, queue in (
                    ("absent", "lagre"), ("busy", "cpu"), ("runs", "cpu"), ("served", "large"),
                    ("new", "lagre"),
                )
            }  # fmt: skip
            await connection.execute(
                "UPDATE jobs SET queued_at = now() - interval '2 hours' WHERE id <> %s", [jobs["new"].id]
            )
            await record_worker_heartbeat(connection, new_id(), name="w", queues=["large"], slots=1, facts={})
            slip = jobs["runs"].slip
        assert slip is not None
        running = await claim(pool, jobs["runs"].id, slip, "w")
        assert running is not None
        assert await give_up(hours=0) == []
        assert await give_up() == ["absent"]
        async with pool.connection() as connection:
            job = await get_job(connection, jobs["absent"].id)
        assert job is not None and job.state == "failed" and job.error is not None and job.slip is None
        assert job.error["type"] == "no_worker" and "--queues lagre" in job.error["message"]
        # A worker that restarts, or is gone for less than the time, gives nothing up.
        async with pool.connection() as connection:
            await connection.execute("UPDATE workers SET seen_at = now() - interval '1 minute'")
            await connection.execute(
                "UPDATE jobs SET heartbeat_at = now() - interval '30 minutes' WHERE state = 'running'"
            )
        assert await give_up() == ["served"]


async def test_workers_may_come_back_after_all_was_switched_off(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        async with pool.connection() as connection:
            served = await create_job(connection, SLIPS, NewJob("me", "toy", {}, "cpu"))
            absent = await create_job(connection, SLIPS, NewJob("me", "toy", {}, "lagre"))
            await connection.execute("UPDATE jobs SET queued_at = now() - interval '4 days'")
        suspects = StalledAttempts(0.3)
        end = partial(fail_abandoned_jobs, pool, SLIPS, stale_seconds=20, hours=72, suspects=suspects)
        assert await end() == []  # the first look, before any worker has said that it lives
        async with pool.connection() as connection:
            await record_worker_heartbeat(connection, new_id(), name="w", queues=["cpu"], slots=1, facts={})
        await asyncio.sleep(0.4)
        assert await end() == [absent.id]
        async with pool.connection() as connection:
            job = await get_job(connection, served.id)
        assert job is not None and job.state == "queued"


async def test_jobs_of_paused_queues_wait_however_long(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        async with pool.connection() as connection:
            job = await create_job(connection, SLIPS, NewJob("me", "toy", {}, "lagre"))
            await connection.execute("UPDATE jobs SET queued_at = now() - interval '4 days'")
            await set_queue_paused(connection, "lagre", True)
        end = partial(
            fail_abandoned_jobs, pool, SLIPS, stale_seconds=20, hours=72, suspects=StalledAttempts(0)
        )
        assert await end() == []
        async with pool.connection() as connection:
            await set_queue_paused(connection, "lagre", False)
        assert await end() == [job.id]
