"""A full disk pauses the queue and loses nothing; room starts it again."""

import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

from octasplat.workers.storage.local import LocalStorage
from tests.support.daily import some_daily
from tests.support.small_disk import fill, small_disk
from tests.support.worker_harness import MAX_WAIT_SECONDS, WorkerHarness

MIB = 1 << 20


@pytest.fixture
def bench(conninfo: str, tmp_path: Path) -> Iterator[WorkerHarness]:
    """Workers whose store and work lie on a disk of 16 MB."""
    with small_disk(tmp_path / "disk", 16) as disk:
        bench = WorkerHarness(conninfo, disk)
        yield bench
        bench.close()


@pytest.mark.exhaustive
def test_jobs_wait_while_disk_space_is_short(bench: WorkerHarness) -> None:
    ballast = fill(bench.folder, 2 * MIB)
    bench.worker(FLOOR_BYTES=str(4 * MIB))
    job_id = bench.submit(options={"steps": 3})
    deadline = time.monotonic() + MAX_WAIT_SECONDS
    while "takes no jobs" not in bench.worker_logs():
        assert time.monotonic() < deadline, bench.worker_logs()
        time.sleep(0.05)
    time.sleep(0.6)
    job = bench.job(job_id)
    assert (job.state, job.attempt) == ("queued", 0)
    ballast.unlink()
    job = bench.wait_until_finished(job_id)
    assert (job.state, job.attempt, job.rescues) == ("succeeded", 1, 0)
    assert "has room again" in bench.worker_logs()


@pytest.mark.parametrize("floor_bytes", some_daily([4 * MIB, 0], {0}))
def test_job_on_full_disk_resumes_from_checkpoint(bench: WorkerHarness, floor_bytes: int) -> None:
    bench.worker(FLOOR_BYTES=str(floor_bytes))
    job_id = bench.submit(options=bench.wait_until_held())
    bench.wait_at_gate(job_id)
    ballast = fill(bench.folder, 0)
    bench.open_gate()
    job = bench.wait(job_id, lambda job: job.state == "queued")
    assert job.error is None and job.rescues == 0
    time.sleep(1.0)
    assert bench.job(job_id).state == "queued"
    ballast.unlink()
    job = bench.wait_until_finished(job_id)
    assert (job.state, job.attempt, job.rescues) == ("succeeded", 2, 0), job
    results = bench.results(job_id)
    assert results["sum.txt"] == b"1830"
    assert [int(line) for line in results["history.txt"].split()] == [0, 30]
    reasons = [event.data["reason"] for event in bench.events(job_id) if event.kind == "handed_back"]
    assert len(reasons) == 1 and "lacks" in reasons[0]


@pytest.mark.exhaustive
def test_garbage_collection_frees_space_for_jobs(bench: WorkerHarness) -> None:
    storage = LocalStorage(bench.folder / "store", floor_bytes=0)
    with storage.open_writer() as writer:
        writer.write(bytes(6 * MIB))
        sha256 = writer.commit().sha256
    # As a worker leaves it: photographs of a dataset that is gone are links to the same content.
    left = bench.folder / "work-w" / "datasets" / str(uuid.uuid4()) / "scene" / "images"
    storage.materialise(sha256, left / "a.jpg")
    fill(bench.folder, 2 * MIB)
    bench.worker(FLOOR_BYTES=str(4 * MIB))
    job = bench.wait_until_finished(bench.submit(options={"steps": 3}))
    assert (job.state, job.attempt, job.rescues) == ("succeeded", 1, 0), job
    assert "unused contents of" in bench.worker_logs() and not left.exists()
    assert sha256 not in {entry.blob.sha256 for entry in storage.list_blobs()}
