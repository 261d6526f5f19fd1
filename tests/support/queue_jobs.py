"""Jobs of a queue that tests claim as workers do."""

import asyncio
import uuid
from collections.abc import Awaitable, Callable
from typing import Any

from octasplat.workers.db.connections import Pool, open_pool
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.attempts import Attempt
from octasplat.workers.queue.claims import claim
from octasplat.workers.queue.jobs import NewJob, create_job, get_job
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue

NEW = NewJob(owner="me", kind="toy", options={}, queue="cpu")
SLIPS = ProcrastinateQueue(stale_seconds=5)


def run(conninfo: str, what: Callable[[Pool], Awaitable[Any]]) -> Any:
    """Return what a coroutine on a pool of connections returns."""

    async def inside() -> Any:
        async with open_pool(conninfo, max_size=6) as pool:
            return await what(pool)

    return asyncio.run(inside())


async def claimed(pool: Pool, job: Job | None = None) -> Attempt:
    """Begin an attempt at a queued job, or at a new one."""
    if job is None:
        async with pool.connection() as connection:
            job = await create_job(connection, SLIPS, NEW)
    assert job.slip is not None
    attempt = await claim(pool, job.id, job.slip, "w")
    assert attempt is not None
    return attempt


async def fetched(pool: Pool, job_id: uuid.UUID) -> Job:
    """Return a job as it is now."""
    async with pool.connection() as connection:
        job = await get_job(connection, job_id)
    assert job is not None
    return job
