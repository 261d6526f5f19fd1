"""Jobs in blocks take their turns as one job each: between owners, and among the jobs of one."""

import uuid
from pathlib import Path

import pytest

from octasplat.engine.core import versions
from octasplat.workers.db.connections import Pool, open_pool
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.attempts import Attempt
from octasplat.workers.queue.block_jobs import NewBlock, blocks_of, cancel_job
from octasplat.workers.queue.claims import claim
from octasplat.workers.queue.fair_share import choose_job, queue_position
from octasplat.workers.queue.jobs import NewJob, create_job, get_job, retry_job
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue
from octasplat.workers.queue.storage_leases import storage_lease
from octasplat.workers.storage.local import LocalStorage
from tests.support.queue_jobs import SLIPS, claimed, fetched


async def queued(pool: Pool, owner: str, label: str, priority: int = 0) -> Job:
    """Queue a job."""
    async with pool.connection() as connection:
        new = NewJob(owner, "toy", {}, "cpu", priority=priority, label=label)
        return await create_job(connection, SLIPS, new)


async def plan(pool: Pool, folder: Path, attempt: Attempt, count: int) -> None:
    """Let an attempt plan blocks of its job."""
    blocks = [NewBlock(n, 10, {"number": n}) for n in range(1, count + 1)]
    checkpoint = {"attempt": 1, "step": 5, "files": [], "results": versions.RESULTS_VERSION}
    async with storage_lease(pool, LocalStorage(folder, floor_bytes=0)) as lease:
        await attempt.start_blocks(SLIPS, checkpoint, "toy", blocks, lease, first_steps=5, total_steps=50)


async def begun(pool: Pool, count: int, *, finish: bool) -> list[str]:
    """Return the labels of the jobs that one worker begins next, with that of the whole before a block's."""
    queue = ProcrastinateQueue(pool, poll_seconds=0.05)
    labels: list[str] = []

    async def deliver(job_id: uuid.UUID, entry_id: int) -> None:
        chosen = await choose_job(pool, SLIPS, job_id, entry_id)
        if chosen is None:  # the entry of an attempt that was begun without it
            return
        attempt = await claim(pool, *chosen, "w")
        assert attempt is not None
        job = attempt.job
        whole = "" if job.root_id is None else f"{(await fetched(pool, job.root_id)).label} "
        labels.append(f"{whole}{job.label}")
        if finish:
            await attempt.succeed([], job_queue=SLIPS)
        if len(labels) == count:
            queue.stop()

    await queue.consume("cpu", 1, deliver)
    return labels


async def ahead(pool: Pool, job: Job) -> int | None:
    """Return how many jobs go before a job as it is now."""
    async with pool.connection() as connection:
        return await queue_position(connection, await fetched(pool, job.id))


@pytest.fixture(name="folder")
def store_folder(tmp_path: Path) -> Path:
    LocalStorage(tmp_path, floor_bytes=0).close()
    return tmp_path


async def test_owners_share_workers_whatever_their_blocks(conninfo: str, folder: Path) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        await plan(pool, folder, await claimed(pool, await queued(pool, "alice", "site")), 100)
        for number in range(20):
            await queued(pool, "bob", f"b{number}")
        owners = [label[0] for label in await begun(pool, 12, finish=False)]
        assert (owners.count("s"), owners.count("b")) == (6, 6)


async def test_blocks_go_where_their_job_does(conninfo: str, folder: Path) -> None:
    """By priority, then by age of the whole; its merge before what was queued after it."""
    async with open_pool(conninfo, max_size=6) as pool:
        early = await queued(pool, "me", "early")
        site = await queued(pool, "me", "site")
        attempt = await claimed(pool, site)
        late = await queued(pool, "me", "late")
        street = await queued(pool, "me", "street")
        later = await queued(pool, "me", "later")
        await plan(
            pool, folder, await claimed(pool, street), 2
        )  # planned first, but asked for after the site
        await plan(pool, folder, attempt, 3)
        urgent = await queued(pool, "me", "urgent", priority=1)
        other = await queued(pool, "you", "other")
        # Of the other owner one at most, and of this one each whole once.
        waiting = [await ahead(pool, job) for job in (urgent, early, late, later, other)]
        assert waiting == [0, 2, 4, 6, 1]
        async with pool.connection() as connection:
            await cancel_job(connection, SLIPS, other.id)
        assert await begun(pool, 11, finish=True) == [
            "urgent",
            "early",
            *(f"site block {number}" for number in (1, 2, 3)),
            "site",
            "late",
            *(f"street block {number}" for number in (1, 2)),
            "street",
            "later",
        ]


async def test_interrupted_block_goes_first_and_a_retried_whole_last(conninfo: str, folder: Path) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        site = await queued(pool, "me", "site")
        await plan(pool, folder, await claimed(pool, site), 3)
        single = await queued(pool, "me", "single")
        async with pool.connection() as connection:
            blocks = await blocks_of(connection, [site.id])
        attempt = await claimed(pool, blocks[2])
        await attempt.requeue(SLIPS, "its worker is stopping")
        assert (await begun(pool, 1, finish=True)) == ["site block 3"]
        async with pool.connection() as connection:
            await cancel_job(connection, SLIPS, site.id)
            await retry_job(connection, SLIPS, site.id, from_start=False)
            again = await get_job(connection, site.id)
        assert again is not None and await ahead(pool, single) == 0
        await plan(pool, folder, await claimed(pool, again), 3)
        assert await begun(pool, 3, finish=True) == ["single", "site block 1", "site block 2"]
