"""Owners share the workers first; priorities order the jobs of one owner."""

from collections import Counter
from collections.abc import Awaitable, Callable

from octasplat.workers.db.connections import Pool, open_pool
from octasplat.workers.db.quotas import Quota, set_quota
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.claims import claim
from octasplat.workers.queue.fair_share import choose_job, queue_position
from octasplat.workers.queue.jobs import NewJob, create_job, get_job, requeue_job
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue

QUEUE = ProcrastinateQueue(stale_seconds=5)


async def queue_jobs(pool: Pool, owner: str, count: int, priority: int = 0) -> list[Job]:
    async with pool.connection() as connection:
        return [
            await create_job(connection, QUEUE, NewJob(owner, "toy", {}, "cpu", priority=priority))
            for _ in range(count)
        ]


async def begin_jobs(pool: Pool, count: int, *, at_once: bool = False) -> list[Job]:
    """Begin jobs as a worker with one slot does, or with many if ``at_once``."""
    queue, begun = ProcrastinateQueue(pool, poll_seconds=0.05), []

    async def deliver(job_id: object, entry_id: int) -> None:
        assert len(begun) < count
        chosen = await choose_job(pool, QUEUE, job_id, entry_id)
        assert chosen is not None
        attempt = await claim(pool, *chosen, "w")
        assert attempt is not None
        begun.append(attempt.job)
        if not at_once:
            await attempt.succeed([])
        if len(begun) == count:
            queue.stop()

    await queue.consume("cpu", 1, deliver)
    return begun


async def test_high_priorities_of_one_owner_keep_no_other_waiting(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        await queue_jobs(pool, "alice", 500, priority=10)
        [job] = await queue_jobs(pool, "bob", 1)
        async with pool.connection() as connection:
            assert await queue_position(connection, job) == 1
        begun = await begin_jobs(pool, 3)
        assert job.id in [each.id for each in begun[:2]]


async def test_priority_orders_jobs_of_one_owner(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        low = await queue_jobs(pool, "alice", 3, priority=-1)
        other = await queue_jobs(pool, "bob", 2, priority=-5)
        high = await queue_jobs(pool, "alice", 2, priority=7)
        begun = [job.id for job in await begin_jobs(pool, 7)]
        mine = [job.id for job in (*high, *low)]
        assert [job_id for job_id in begun if job_id in mine] == mine
        assert begun.index(other[1].id) <= 3


async def test_owner_with_greater_share_gets_more(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        async with pool.connection() as connection:
            await set_quota(connection, "alice", Quota(share=3))
        for owner in ("alice", "bob"):
            await queue_jobs(pool, owner, 20)
        running = Counter(job.owner for job in await begin_jobs(pool, 12, at_once=True))
        assert running == {"alice": 9, "bob": 3}


async def test_delayed_jobs_do_not_hold_up_those_behind_them(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        delayed = await queue_jobs(pool, "alice", 10, priority=5)
        [ready] = await queue_jobs(pool, "alice", 1)
        await queue_jobs(pool, "bob", 1, priority=9)
        async with pool.connection() as connection, connection.transaction():
            for job in delayed:
                await requeue_job(connection, QUEUE, job, delay_seconds=600, without_event=True)
        assert {job.owner: job.id for job in await begin_jobs(pool, 2)}["alice"] == ready.id
        async with pool.connection() as connection:
            row = await get_job(connection, delayed[0].id)
        assert row is not None and row.state == "queued"


async def test_choice_costs_what_owners_cost(conninfo: str) -> None:
    async with open_pool(conninfo, max_size=1) as pool:
        [first] = await queue_jobs(pool, "alice", 1)
        [other] = await queue_jobs(pool, "bob", 1)

        async def choose() -> None:
            async with pool.connection() as connection:
                job = await get_job(connection, first.id)
            assert job is not None and job.slip is not None
            await choose_job(pool, QUEUE, job.id, job.slip)

        async def tell_position() -> None:
            async with pool.connection() as connection:
                assert await queue_position(connection, other) == 1

        before = [await _rows_read(pool, action) for action in (choose, tell_position)]
        async with pool.connection() as connection:
            await connection.execute(
                """
                INSERT INTO jobs (id, owner, kind, options, queue, priority, slip)
                SELECT gen_random_uuid(), 'alice', 'toy', '{}', 'cpu', 0, n FROM generate_series(1000, 5000) n
                """
            )
            await connection.execute("ANALYZE jobs")
        assert await _rows_read(pool, choose) < before[0] + 20
        assert await _rows_read(pool, tell_position) < before[1] + 20


async def _rows_read(pool: Pool, action: Callable[[], Awaitable[None]]) -> int:
    """Return how many rows of the jobs an action reads."""
    counts = []
    for act in (False, True):
        if act:
            await action()
        async with pool.connection() as connection:
            await connection.execute("SELECT pg_stat_force_next_flush()")
        async with pool.connection() as connection:
            cursor = await connection.execute(
                "SELECT seq_tup_read + idx_tup_fetch AS n FROM pg_stat_user_tables WHERE relname = 'jobs'"
            )
            row = await cursor.fetchone()
            assert row is not None
            counts.append(int(row["n"]))
    return counts[1] - counts[0]
