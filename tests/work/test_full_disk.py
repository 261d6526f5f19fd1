"""A full disk pauses the queue and loses nothing; room starts it again."""

import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
from worker_bench import PATIENCE_SECONDS, Bench

from octasplat.workers.store.local import LocalStorage
from small_disk import fill, small_disk

MIB = 1 << 20


@pytest.fixture
def bench(conninfo: str, tmp_path: Path) -> Iterator[Bench]:
    """Workers whose store and work lie on a disk of 16 MB."""
    with small_disk(tmp_path / "disk", 16) as disk:
        bench = Bench(conninfo, disk)
        yield bench
        bench.close()


def test_below_the_floor_jobs_wait(bench: Bench) -> None:
    ballast = fill(bench.folder, 2 * MIB)
    bench.worker(FLOOR_BYTES=str(4 * MIB))
    job_id = bench.submit(options={"steps": 3})
    deadline = time.monotonic() + PATIENCE_SECONDS
    while "takes no jobs" not in bench.worker_logs():
        assert time.monotonic() < deadline, bench.worker_logs()
        time.sleep(0.05)
    time.sleep(0.6)
    job = bench.job(job_id)
    assert (job.state, job.attempt) == ("queued", 0)
    ballast.unlink()
    job = bench.over(job_id)
    assert (job.state, job.attempt, job.rescues) == ("succeeded", 1, 0)
    assert "has room again" in bench.worker_logs()


@pytest.mark.parametrize("floor_bytes", [4 * MIB, 0])
def test_a_job_that_meets_a_full_disk_goes_on_from_its_checkpoint(bench: Bench, floor_bytes: int) -> None:
    bench.worker(FLOOR_BYTES=str(floor_bytes))
    job_id = bench.submit(options=bench.held())
    bench.wait_at_gate(job_id)
    ballast = fill(bench.folder, 0)
    bench.open_gate()
    job = bench.wait(job_id, lambda job: job.state == "queued")
    assert job.error is None and job.rescues == 0
    time.sleep(1.0)
    assert bench.job(job_id).state == "queued"
    ballast.unlink()
    job = bench.over(job_id)
    assert (job.state, job.attempt, job.rescues) == ("succeeded", 2, 0), job
    results = bench.results(job_id)
    assert results["sum.txt"] == b"1830"
    assert [int(line) for line in results["history.txt"].split()] == [0, 30]
    reasons = [event.data["reason"] for event in bench.events(job_id) if event.kind == "handed_back"]
    assert len(reasons) == 1 and "lacks" in reasons[0]


def test_what_nothing_names_makes_room_for_jobs(bench: Bench) -> None:
    storage = LocalStorage(bench.folder / "store", floor_bytes=0)
    with storage.begin() as writer:
        writer.write(bytes(6 * MIB))
        sha256 = writer.commit().sha256
    # As a worker leaves it: photographs of a dataset that is gone are links to the same content.
    left = bench.folder / "work-w" / "datasets" / str(uuid.uuid4()) / "scene" / "images"
    storage.materialise(sha256, left / "a.jpg")
    fill(bench.folder, 2 * MIB)
    bench.worker(FLOOR_BYTES=str(4 * MIB))
    job = bench.over(bench.submit(options={"steps": 3}))
    assert (job.state, job.attempt, job.rescues) == ("succeeded", 1, 0), job
    assert "unused contents of" in bench.worker_logs() and not left.exists()
    assert sha256 not in {entry.blob.sha256 for entry in storage.blobs()}
