"""Jobs in blocks: one job for its owner, whatever becomes of the workers that train its blocks."""

import signal
import uuid
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psycopg
import pytest

from octasplat.workers.db.connections import open_pool
from octasplat.workers.db.errors import ConflictError
from octasplat.workers.db.quotas import usage_of
from octasplat.workers.db.rows import Job
from octasplat.workers.queue.block_jobs import NewBlock, blocks_of
from octasplat.workers.queue.jobs import artifacts_of, delete_job, list_jobs
from octasplat.workers.queue.storage_leases import storage_lease
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.worker.outcomes import OutcomeWriter
from tests.support.queue_jobs import SLIPS, claimed, fetched
from tests.support.worker_harness import WorkerHarness

KINDS: dict[str, Any] = {"KIND_MODULES": '["tests.support.toy_kind", "tests.support.block_toys"]'}
SOON: dict[str, Any] = {"STALE_SECONDS": "15", **KINDS}
DONE = b"1:11 2:12 3:13"


def blocks(bench: WorkerHarness, root: uuid.UUID) -> list[Job]:
    found: list[Job] = bench.run_query(lambda c: blocks_of(c, [root]))
    return found


def states(bench: WorkerHarness, root: uuid.UUID) -> list[str]:
    return [job.state for job in blocks(bench, root)]


def submit(bench: WorkerHarness, **options: Any) -> uuid.UUID:
    return bench.submit("block_toy", options={"gate": str(bench.gate), **options})


def rows(bench: WorkerHarness, table: str) -> int:
    with psycopg.connect(bench.conninfo) as connection:
        found = connection.execute(f"SELECT count(*) FROM {table}".encode()).fetchone()
    assert found is not None
    return int(found[0])


@pytest.mark.parametrize("workers", [pytest.param(1, marks=pytest.mark.exhaustive), 2])
def test_blocks_are_trained_by_all_workers_and_one_job_is_seen(bench: WorkerHarness, workers: int) -> None:
    for number in range(workers):
        bench.worker(name=f"w{number}", **KINDS)
    root = submit(bench)
    job = bench.wait_until_finished(root)
    assert (job.state, job.error, job.role, job.attempt) == ("succeeded", None, "root", 2)
    assert (job.stage, job.step, job.total_steps) == ("train", 5 + 11 + 12 + 13, 5 + 11 + 12 + 13 + 5)
    assert bench.results(root) == {"sum.txt": DONE}
    children = blocks(bench, root)
    assert [child.options["number"] for child in children] == [1, 2, 3]
    assert {child.state for child in children} == {"succeeded"}
    assert [job.id for job in bench.run_query(list_jobs)] == [root]
    # What the blocks have made is in the results of the whole, and theirs is not kept.
    assert all(bench.results(child.id) == {} for child in children) and rows(bench, "job_needs") == 0
    kinds = [event.kind for event in bench.events(root)]
    assert kinds.count("blocks_queued") == 1 and kinds.count("block_finished") == 3
    with pytest.raises(ConflictError, match="is a block of the job"):
        bench.run_query(lambda c: delete_job(c, children[0].id))
    with pytest.raises(ConflictError, match="is a block of the job"):
        bench.cancel(children[0].id)
    bench.run_query(lambda c: delete_job(c, root))
    assert rows(bench, "jobs") == 0


@pytest.mark.exhaustive
def test_worker_killed_during_a_block_is_replaced(bench: WorkerHarness) -> None:
    first = bench.worker(name="first", **SOON)
    root = submit(bench, hold=1)
    # The longest block goes first.
    bench.wait(
        root, lambda _: [(child.checkpoint or {}).get("step") for child in blocks(bench, root)][-1:] == [5]
    )
    waiting = bench.job(root)
    assert (waiting.state, waiting.heartbeat_at, waiting.worker) == ("running", None, None)
    assert bench.run_query(lambda c: usage_of(c, "me")).jobs == 1
    bench.worker(name="second", **SOON)
    bench.wait_until_up("second")
    first.send_signal(signal.SIGKILL)
    bench.wait(root, lambda _: any(child.worker == "second" for child in blocks(bench, root)))
    bench.open_gate()
    job = bench.wait_until_finished(root)
    assert job.state == "succeeded" and bench.results(root) == {"sum.txt": DONE}
    children = blocks(bench, root)
    assert children[2].attempt >= 2
    resumed = [event for event in bench.events(children[2].id) if event.kind == "resumed"]
    assert resumed[0].data["step"] == 5


@pytest.mark.exhaustive
@pytest.mark.parametrize("damage", ["gone", "damaged"])
def test_results_lost_from_the_store_are_made_again(bench: WorkerHarness, damage: str) -> None:
    for number in range(2):
        bench.worker(name=f"w{number}", **KINDS)
    root = submit(bench, hold=3)
    bench.wait(root, lambda _: states(bench, root) == ["succeeded", "succeeded", "running"])
    first = blocks(bench, root)[0]
    results = bench.run_query(lambda c: artifacts_of(c, first.id))
    [sha256] = [result.sha256 for result in results if result.name.endswith("best.npz")]
    [stored] = (bench.folder / "store").rglob(sha256)
    if damage == "gone":
        stored.unlink()
    else:
        stored.chmod(0o600)
        stored.write_bytes(b"9:99")
    bench.open_gate()
    job = bench.wait_until_finished(root)
    assert (job.state, job.error) == ("succeeded", None) and bench.results(root) == {"sum.txt": DONE}
    assert [child.attempt for child in blocks(bench, root)] == [2, 1, 1]
    warnings = [event.data["message"] for event in bench.events(root) if event.kind == "warning"]
    assert warnings == ["The results of block 1 are gone from the store; it is trained again."]
    assert job.count_starts(job.attempt) == 1


@pytest.mark.exhaustive
def test_failed_block_fails_the_whole_and_a_retry_keeps_what_succeeded(bench: WorkerHarness) -> None:
    bench.worker(**KINDS)
    root = submit(bench, refuse=2)
    job = bench.wait_until_finished(root)
    assert job.state == "failed" and job.error is not None
    assert job.error["type"] == "dataset_error" and job.error["block"] == 2
    assert job.error["message"].startswith("Block 2 of 3 failed: The toy refuses this block.")
    assert states(bench, root) == ["canceled", "failed", "succeeded"]  # the longest first
    bench.open_gate()
    assert bench.retry(root).state == "queued"
    assert bench.wait_until_finished(root).state == "succeeded"
    assert bench.results(root) == {"sum.txt": DONE}
    assert [child.attempt for child in blocks(bench, root)] == [1, 2, 1]


@pytest.mark.exhaustive
def test_retry_under_a_version_with_a_further_setting_keeps_what_succeeded(bench: WorkerHarness) -> None:
    bench.worker(**KINDS)
    root = submit(bench, refuse=2)
    bench.wait_until_finished(root)
    with psycopg.connect(bench.conninfo) as connection:  # as blocks of the version before that setting
        connection.execute("UPDATE jobs SET options = options - 'steps' WHERE root_id = %s", [root])
    bench.open_gate()
    bench.retry(root)
    assert bench.wait_until_finished(root).state == "succeeded"
    assert bench.results(root) == {"sum.txt": DONE}
    assert [child.attempt for child in blocks(bench, root)] == [1, 2, 1]


@pytest.mark.exhaustive
def test_cancelling_ends_all_blocks_and_a_retry_goes_on(bench: WorkerHarness) -> None:
    bench.worker(**KINDS)
    root = submit(bench, hold=1)
    bench.wait(root, lambda _: any(child.state == "running" for child in blocks(bench, root)))
    assert bench.cancel(root).state == "canceling"
    job = bench.wait_until_finished(root)
    assert (job.state, job.error) == ("canceled", None)
    assert set(states(bench, root)) == {"canceled"}
    bench.open_gate()
    bench.retry(root)
    assert bench.wait_until_finished(root).state == "succeeded"
    assert bench.results(root) == {"sum.txt": DONE}


@pytest.mark.exhaustive
def test_cancelled_whole_without_workers_ends_at_once(bench: WorkerHarness) -> None:
    worker = bench.worker(**KINDS)
    root = submit(bench, hold=1)
    bench.wait(root, lambda _: any(child.state == "running" for child in blocks(bench, root)))
    worker.terminate()
    assert worker.wait(60) == 0
    assert set(states(bench, root)) == {"queued"}
    assert bench.cancel(root).state == "canceled"
    assert set(states(bench, root)) == {"canceled"} and rows(bench, "procrastinate_jobs") == 0


@pytest.mark.exhaustive
def test_retry_from_the_start_plans_anew(bench: WorkerHarness) -> None:
    bench.worker(**KINDS)
    root = submit(bench, refuse=2)
    bench.wait_until_finished(root)
    before = {child.id for child in blocks(bench, root)}
    bench.open_gate()
    bench.retry(root, fresh=True)
    assert bench.wait_until_finished(root).state == "succeeded"
    assert before.isdisjoint(child.id for child in blocks(bench, root))


@pytest.mark.exhaustive
def test_lost_database_in_the_middle_is_outlived(bench: WorkerHarness) -> None:
    bench.worker(**KINDS)
    root = submit(bench, hold=1)
    bench.wait(root, lambda _: any(child.state == "running" for child in blocks(bench, root)))
    with bench.disconnect_database():
        pass
    bench.open_gate()
    bench.worker(name="after", **KINDS)  # in case that the first ends over it, to be started again
    assert bench.wait_until_finished(root).state == "succeeded"
    assert bench.results(root) == {"sum.txt": DONE}


async def test_worker_that_ends_with_the_last_block_leaves_the_whole_queued(
    conninfo: str, tmp_path: Path
) -> None:
    async with open_pool(conninfo, max_size=4) as pool:
        whole = await claimed(pool)
        async with storage_lease(pool, LocalStorage(tmp_path, floor_bytes=0)) as lease:
            await whole.start_blocks(
                SLIPS, {"files": []}, "toy", [NewBlock(1, 5, {"number": 1})], lease,
                first_steps=0, total_steps=5,
            )  # fmt: skip
        async with pool.connection() as connection:
            [block] = await blocks_of(connection, [whole.job.id])
        context: Any = SimpleNamespace(
            job_queue=SLIPS,
            settings=SimpleNamespace(heartbeat_seconds=5.0),
            host_health=SimpleNamespace(record_success=lambda: None),
        )
        workspace: Any = SimpleNamespace(read_psnr=lambda _results: None)
        unused: Any = None
        writer = OutcomeWriter(await claimed(pool, block), context, workspace, unused, unused, "")
        await writer.succeed([])
        assert (await fetched(pool, whole.job.id)).state == "queued"
