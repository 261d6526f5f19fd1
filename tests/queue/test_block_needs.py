"""Jobs in blocks in the tables: queued once, released once, and settled whoever has died in between."""

import asyncio
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from octasplat.engine.core import versions
from octasplat.workers.db.connections import Pool, open_pool
from octasplat.workers.db.errors import ConflictError
from octasplat.workers.db.events_and_logs import list_log_lines
from octasplat.workers.db.quotas import Quota, QuotaExceededError, check_new_job, set_quota, usage_of
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.attempts import Attempt, FencedError
from octasplat.workers.queue.block_jobs import (
    NewBlock,
    blocks_of,
    cancel_job,
    settle_root,
    unsettled_roots,
)
from octasplat.workers.queue.block_results import files_from_others
from octasplat.workers.queue.fair_share import choose_job
from octasplat.workers.queue.job_results import ResultFile
from octasplat.workers.queue.jobs import (
    create_job,
    delete_job,
    list_jobs,
    lock_blocks,
    requeue_job,
    retry_job,
)
from octasplat.workers.queue.recovery import StalledAttempts, recover_stalled_jobs
from octasplat.workers.queue.storage_leases import storage_lease
from octasplat.workers.queue.usage_figures import running_by_queue, worked_seconds
from octasplat.workers.storage.errors import BlobNotFoundError
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.worker.checkpoint import Checkpoint, plan_digest
from octasplat.workers.worker.job_inputs import read_inputs
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.task import BlocksPlanned, read_planned_blocks
from tests.support.queue_jobs import NEW, SLIPS, claimed, fetched

PLANNED = "f" * 64
AS_RESTORED = "UPDATE jobs SET state = 'queued', worker = NULL WHERE state = 'running'"


def checkpoint() -> dict[str, object]:
    files = [{"path": "run/blocks/plan.npz", "sha256": PLANNED, "size_bytes": 7}]
    return {"attempt": 1, "stage": "train", "step": 5, "files": files, "results": versions.RESULTS_VERSION}


async def start(
    pool: Pool,
    folder: Path,
    attempt: Attempt,
    numbers: Sequence[int] = (1, 2),
    disk_bytes: Mapping[int, int] | None = None,
) -> Job:
    """Let an attempt plan blocks; return the job that waits for them."""
    plan, taken = plan_digest(Checkpoint.from_row(checkpoint())), disk_bytes or {}
    blocks = [
        NewBlock(n, 10 * n, {"number": n, "iterations": 10 * n, "plan": plan}, taken.get(n)) for n in numbers
    ]
    async with storage_lease(pool, LocalStorage(folder, floor_bytes=0)) as lease:
        await attempt.start_blocks(
            SLIPS, checkpoint(), "toy", blocks, lease, first_steps=5, total_steps=5 + 10 * sum(numbers)
        )
    return await fetched(pool, attempt.job.id)


async def test_block_asks_for_the_disk_that_it_takes_itself(conninfo: str, folder: Path) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        new = replace(NEW, estimate={"disk_bytes": 9_000, "memory_bytes": 70})
        async with pool.connection() as connection:
            attempt = await claimed(pool, await create_job(connection, SLIPS, new))
        root = await start(pool, folder, attempt, disk_bytes={2: 800})
        assert [block.estimate for block in await children(pool, root.id)] == [
            {"disk_bytes": 9_000, "memory_bytes": 70}, {"disk_bytes": 800, "memory_bytes": 70}
        ]  # fmt: skip
        assert root.estimate == new.estimate


PLAN = {"numbers": [1, 3], "iterations": [20, 10], "first_iterations": 5, "total_iterations": 50}


def test_plan_of_a_program_is_read_with_the_disk_of_each_block() -> None:
    told = BlocksPlanned((1, 3), (20, 10), 5, 50)
    assert read_planned_blocks(PLAN) == told  # as of another version
    assert read_planned_blocks({**PLAN, "disk_bytes": [1 << 40, 7]}) == replace(told, disk_bytes=(1 << 40, 7))
    for wrong in ([7], [7, -1], [7, 1 << 60], [7, "x"], 7):
        assert read_planned_blocks({**PLAN, "disk_bytes": wrong}) is None


async def children(pool: Pool, root: uuid.UUID) -> list[Job]:
    async with pool.connection() as connection:
        return await blocks_of(connection, [root])


async def settle(pool: Pool, root: uuid.UUID) -> Job:
    async with pool.connection() as connection:
        await settle_root(connection, SLIPS, root)
    return await fetched(pool, root)


@pytest.fixture(name="folder")
def store_folder(tmp_path: Path) -> Path:
    storage = LocalStorage(tmp_path, floor_bytes=0)
    storage.close()
    return tmp_path


async def test_last_block_that_succeeds_queues_the_whole_once(conninfo: str, folder: Path) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        attempt = await claimed(pool)
        root = await start(pool, folder, attempt)
        assert (root.state, root.heartbeat_at, root.worker, root.step) == ("running", None, None, 5)
        for write in (attempt.heartbeat, attempt.cancel):  # its attempt is over
            with pytest.raises(FencedError):
                await write()
        blocks = await children(pool, root.id)
        assert [block.state for block in blocks] == ["queued", "queued"]
        assert blocks[1].slip is not None and blocks[0].slip is not None and blocks[1].slip < blocks[0].slip
        attempts = [await claimed(pool, block) for block in blocks]
        async with pool.connection() as connection:
            files = await files_from_others(connection, attempts[0].job)
            assert [file.path for file in files] == ["run/blocks/plan.npz"]
        results = [ResultFile(f"blocks/block_00{n}/best.npz", str(n) * 64, n, "x") for n in (1, 2)]
        await asyncio.gather(
            *(done.succeed([result], job_queue=SLIPS) for done, result in zip(attempts, results, strict=True))
        )
        root = await fetched(pool, root.id)
        assert root.state == "queued"
        last = await claimed(pool, root)
        async with pool.connection() as connection:
            files = await files_from_others(connection, last.job)
            assert [(file.path, file.size_bytes) for file in files] == [
                ("run/blocks/block_001/best.npz", 1),
                ("run/blocks/block_002/best.npz", 2),
            ]
            assert (await usage_of(connection, "me")).bytes == 7 + 1 + 2
        await last.succeed([ResultFile("scene.ply", "9" * 64, 100, "x")], job_queue=SLIPS)
        async with pool.connection() as connection:
            assert (await usage_of(connection, "me")).bytes == 100
            assert await unsettled_roots(connection) == []


async def test_one_job_is_listed_and_counted(conninfo: str, folder: Path) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        root = await start(pool, folder, await claimed(pool), (1, 2, 3))
        async with pool.connection() as connection:
            assert [job.id for job in await list_jobs(connection, owner="me")] == [root.id]
            assert (await usage_of(connection, "me")).jobs == 1
            await set_quota(connection, "me", Quota(max_jobs=2))
            await check_new_job(connection, "me")
            await create_job(connection, SLIPS, NEW)
            with pytest.raises(QuotaExceededError):
                await check_new_job(connection, "me")
            # It keeps no worker busy while it waits.
            assert await running_by_queue(connection) == {} and await running_by_queue(connection, "me") == {
                "cpu": 1
            }
            with pytest.raises(ConflictError, match=str(root.id)):
                await retry_job(
                    connection, SLIPS, (await blocks_of(connection, [root.id]))[0].id, from_start=False
                )


async def test_blocks_of_one_owner_leave_others_their_turn(conninfo: str, folder: Path) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        root = await start(pool, folder, await claimed(pool), (1, 2, 3))
        blocks = await children(pool, root.id)
        await claimed(pool, blocks[2])
        async with pool.connection() as connection:
            other = await create_job(
                connection, SLIPS, type(NEW)(owner="you", kind="toy", options={}, queue="cpu")
            )
        assert blocks[1].slip is not None
        assert await choose_job(pool, SLIPS, blocks[1].id, blocks[1].slip) == (other.id, other.slip)


async def test_recovery_leaves_a_waiting_job_and_settles_what_nobody_did(conninfo: str, folder: Path) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        root = await start(pool, folder, await claimed(pool))
        assert await recover_stalled_jobs(pool, SLIPS, 0.0, StalledAttempts(0.0)) == 0
        assert (await fetched(pool, root.id)).waits_for_blocks
        for block in await children(pool, root.id):  # without a queue: as if the worker had died just then
            await (await claimed(pool, block)).succeed([])
        assert (await fetched(pool, root.id)).state == "running"
        await recover_stalled_jobs(pool, SLIPS, 60.0, StalledAttempts(0.0))
        assert (await fetched(pool, root.id)).state == "queued"


async def test_failed_block_ends_the_others_and_the_whole(conninfo: str, folder: Path) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        root = await start(pool, folder, await claimed(pool), (1, 2, 3))
        first, second, third = [await claimed(pool, block) for block in await children(pool, root.id)][:3]
        await third.succeed([ResultFile("blocks/block_003/best.npz", "3" * 64, 3, "x")], job_queue=SLIPS)
        await second.fail({"type": "training", "message": "It collapsed."})
        assert (await settle(pool, root.id)).state == "canceling"
        assert await first.read_state() == "canceling"
        await first.cancel()
        ended = await settle(pool, root.id)
        assert ended.state == "failed" and ended.error == {
            "type": "training",
            "message": "Block 2 of 3 failed: It collapsed. The others' results are kept.",
            "block": 2,
        }
        async with pool.connection() as connection:
            await retry_job(connection, SLIPS, root.id, from_start=False)
        root = await start(pool, folder, await claimed(pool, await fetched(pool, root.id)), (1, 2, 3))
        assert [block.state for block in await children(pool, root.id)] == ["queued", "queued", "succeeded"]
        assert root.error is None and root.checkpoint is not None


@pytest.mark.parametrize("begun", [False, True], ids=["queued", "begun"])
async def test_job_cancelled_as_its_merge_begins_keeps_its_blocks(
    conninfo: str, folder: Path, begun: bool
) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        root = await start(pool, folder, await claimed(pool))
        for block in await children(pool, root.id):
            await (await claimed(pool, block)).succeed([], job_queue=SLIPS)
        root = await fetched(pool, root.id)
        assert root.state == "queued"
        merge = await claimed(pool, root) if begun else None
        async with pool.connection() as connection:
            await cancel_job(connection, SLIPS, root.id)
        if merge is not None:
            assert await merge.read_state() == "canceling"
            await merge.cancel()
        assert (await settle(pool, root.id)).state == "canceled"
        assert {block.state for block in await children(pool, root.id)} == {"succeeded"}
        async with pool.connection() as connection:
            assert await unsettled_roots(connection) == []
            await retry_job(connection, SLIPS, root.id, from_start=False)
        again = await claimed(pool, await fetched(pool, root.id))
        await again.succeed([], job_queue=SLIPS)
        assert (await fetched(pool, root.id)).state == "succeeded"


@pytest.mark.parametrize("from_start", [False, True])
async def test_retry_of_a_job_cancelled_before_its_merge_is_a_start_of_its_own(
    conninfo: str, folder: Path, from_start: bool
) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        root = await start(pool, folder, await claimed(pool))
        for block in await children(pool, root.id):
            await (await claimed(pool, block)).succeed([], job_queue=SLIPS)
        async with pool.connection() as connection:
            canceled = await cancel_job(connection, SLIPS, root.id)
            assert canceled.state == "canceled"
            await retry_job(connection, SLIPS, root.id, from_start=from_start)
        again = (await claimed(pool, await fetched(pool, root.id))).job
        assert (again.attempt, again.count_starts(again.attempt)) == (2, 2)
        async with pool.connection() as connection:
            lines = await list_log_lines(connection, root.id)
        assert [line.text for line in lines if line.attempt == 2] == ["Attempt 2"]


async def test_results_lost_twice_fail_with_the_name_of_the_block(conninfo: str, folder: Path) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        root = await start(pool, folder, await claimed(pool))
        for trial in range(2):
            for block in await children(pool, root.id):
                if block.state == "queued":
                    digest = str(block.options["number"]) * 64
                    result = ResultFile("blocks/best.npz", digest, 1, "x")
                    await (await claimed(pool, block)).succeed([result], job_queue=SLIPS)
            merge = await claimed(pool, await fetched(pool, root.id))
            if trial:
                with pytest.raises(BlobNotFoundError, match="block 2 are gone from the store once more"):
                    await merge.drop_lost_blocks({"2" * 64})
                break
            await merge.drop_lost_blocks({"2" * 64})
            async with pool.connection() as connection:
                assert [file.sha256[0] for file in await files_from_others(connection, merge.job)] == ["1"]
            root = await start(pool, folder, merge)
            assert [block.state for block in await children(pool, root.id)] == ["succeeded", "queued"]


async def test_job_that_waits_for_blocks_takes_no_time_of_workers(conninfo: str, folder: Path) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        root = await start(pool, folder, await claimed(pool))
        async with pool.connection() as connection:
            await connection.execute(
                "UPDATE jobs SET started_at = now() - interval '1000 s' WHERE id = %s", [root.id]
            )
            await connection.execute(
                "UPDATE job_events SET at = now() - interval '900 s' WHERE kind = 'blocks_queued'"
            )
            assert await worked_seconds(connection, "me") == pytest.approx(100, abs=5)
            await cancel_job(connection, SLIPS, root.id)
            assert await worked_seconds(connection, "me") == pytest.approx(100, abs=5)


async def test_results_of_another_plan_are_not_merged(conninfo: str, folder: Path) -> None:
    """A job that began anew, as under a version with other results, and lost its worker as it planned."""
    kind = get_job_kind("reconstruct")

    async def taken_over(attempt: Attempt) -> list[str]:
        async with attempt.pool.connection() as connection:
            inputs = await read_inputs(connection, attempt.job, kind, kind.resolve({}))
        return [file.path for file in inputs.others]

    async with open_pool(conninfo, max_size=6) as pool:
        root = await start(pool, folder, await claimed(pool))
        for block in await children(pool, root.id):
            result = ResultFile(f"blocks/block_00{block.options['number']}/best.npz", "1" * 64, 1, "x")
            await (await claimed(pool, block)).succeed([result], job_queue=SLIPS)
        merge = await claimed(pool, await fetched(pool, root.id))
        assert len(await taken_over(merge)) == 2
        files = [
            {
                "path": "run/blocks/coarse/checkpoints/iteration_0000010.npz",
                "sha256": "a" * 64,
                "size_bytes": 1,
            }
        ]
        await merge.record_checkpoint({**checkpoint(), "files": files}, is_progress=True)
        await merge.requeue(SLIPS, "its worker stops")
        again = await claimed(pool, await fetched(pool, root.id))
        assert await taken_over(again) == []
        # planned as before after all: what the blocks have made is kept
        root = await start(pool, folder, again)
        assert (await settle(pool, root.id)).state == "queued"
        assert len(await taken_over(await claimed(pool, await fetched(pool, root.id)))) == 2


async def test_whole_that_cannot_be_merged_does_not_begin_anew_for_ever(conninfo: str, folder: Path) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        root = await start(pool, folder, await claimed(pool))
        for block in await children(pool, root.id):
            await (await claimed(pool, block)).succeed([], job_queue=SLIPS)
        for _ in range(2):
            # planned again with all blocks there: once for a lost checkpoint, but no third merge
            root = await start(pool, folder, await claimed(pool, await fetched(pool, root.id)))
            root = await settle(pool, root.id)
        assert root.state == "failed" and root.error is not None
        assert "Retry the job from the start" in root.error["message"]
        async with pool.connection() as connection:
            await retry_job(connection, SLIPS, root.id, from_start=False)
        root = await start(pool, folder, await claimed(pool, await fetched(pool, root.id)))
        assert (await settle(pool, root.id)).state == "queued"


@pytest.mark.parametrize("ending", ["canceled", "canceled under way", "failed"])
async def test_blocks_do_not_outlive_a_job_that_was_restored_from_a_backup(
    conninfo: str, folder: Path, ending: str
) -> None:
    """It is queued then, with blocks that wait or run, and not only waits for these."""
    async with open_pool(conninfo, max_size=6) as pool:
        root = await start(pool, folder, await claimed(pool), (1, 2, 3))
        done, running, _ = await children(pool, root.id)
        await (await claimed(pool, done)).succeed([], job_queue=SLIPS)
        async with pool.connection() as connection:
            await connection.execute(AS_RESTORED)
            for orphan in (root, running):
                await requeue_job(connection, SLIPS, await fetched(pool, orphan.id))
        under_way = await claimed(pool, await fetched(pool, running.id))
        again = None if ending == "canceled" else await claimed(pool, await fetched(pool, root.id))
        if ending != "failed":
            async with pool.connection() as connection:
                await cancel_job(connection, SLIPS, root.id)
        if again is not None:
            await (again.fail({"type": "x", "message": "y"}) if ending == "failed" else again.cancel())
        await recover_stalled_jobs(pool, SLIPS, 5, StalledAttempts(5))
        assert [block.state for block in await children(pool, root.id)] == [
            "succeeded", "canceling", "canceled",
        ]  # fmt: skip
        async with pool.connection() as connection:
            assert await unsettled_roots(connection) == []
            await retry_job(connection, SLIPS, root.id, from_start=False)  # before that block has stopped
        root = await start(pool, folder, await claimed(pool, await fetched(pool, root.id)), (1, 2, 3))
        with pytest.raises(FencedError):
            await under_way.cancel()
        assert (await settle(pool, root.id)).waits_for_blocks
        assert [block.state for block in await children(pool, root.id)] == ["succeeded", "queued", "queued"]
        async with pool.connection() as connection:
            assert await unsettled_roots(connection) == []


async def test_cancelling_by_a_front_end_of_the_last_version_is_settled(conninfo: str, folder: Path) -> None:
    """Which changes the state of a job that runs, and leaves the rest to its worker."""
    async with open_pool(conninfo, max_size=6) as pool:
        root = await start(pool, folder, await claimed(pool))
        async with pool.connection() as connection:
            await connection.execute("UPDATE jobs SET state = 'canceling' WHERE id = %s", [root.id])
        await recover_stalled_jobs(pool, SLIPS, 60.0, StalledAttempts(0.0))
        assert (await fetched(pool, root.id)).state == "canceled"
        assert {block.state for block in await children(pool, root.id)} == {"canceled"}


async def test_cancelling_and_succeeding_at_once_end_somehow(conninfo: str, folder: Path) -> None:
    async with open_pool(conninfo, max_size=6) as pool:
        for _ in range(5):
            root = await start(pool, folder, await claimed(pool))
            attempts = [await claimed(pool, block) for block in await children(pool, root.id)]

            async def cancel(root_id: uuid.UUID = root.id) -> None:
                async with pool.connection() as connection:
                    await cancel_job(connection, SLIPS, root_id)

            await asyncio.gather(cancel(), *(attempt.succeed([], job_queue=SLIPS) for attempt in attempts))
            assert (await settle(pool, root.id)).state in ("canceled", "queued")


@pytest.mark.parametrize("way", ["plan", "lost", "retry", "delete"])
async def test_blocks_are_locked_before_the_job_that_waits_for_them(
    conninfo: str, folder: Path, way: str
) -> None:
    """As whoever cancels the job does; two that take both in other orders would wait for each other."""
    async with open_pool(conninfo, max_size=8) as pool:
        root = await start(pool, folder, await claimed(pool))
        if way in ("plan", "lost"):
            for block in await children(pool, root.id):
                results = [ResultFile("blocks/best.npz", str(block.options["number"]) * 64, 1, "x")]
                await (await claimed(pool, block)).succeed(results, job_queue=SLIPS)
            merge = await claimed(pool, await fetched(pool, root.id))
        else:
            async with pool.connection() as connection:
                await cancel_job(connection, SLIPS, root.id)

        async def change() -> None:
            if way == "plan":
                await start(pool, folder, merge)
            elif way == "lost":
                await merge.drop_lost_blocks({"2" * 64})
            else:
                async with pool.connection() as connection:
                    if way == "retry":
                        await retry_job(connection, SLIPS, root.id, from_start=True)
                    else:
                        await delete_job(connection, root.id)

        async with pool.connection() as connection, connection.transaction():
            await lock_blocks(connection, root.id)
            changing = asyncio.create_task(change())
            await asyncio.sleep(0.5)
            assert not changing.done()
            found = await connection.execute("SELECT id FROM jobs WHERE id = %s FOR UPDATE NOWAIT", [root.id])
            assert await found.fetchone() is not None
        await changing
