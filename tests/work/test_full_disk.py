"""A full disk pauses the queue and loses nothing; room starts it again."""

import os
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from worker_bench import PATIENCE_SECONDS, Bench

MIB = 1 << 20


@pytest.fixture
def bench(conninfo: str, tmp_path: Path) -> Iterator[Bench]:
    """Workers whose store and work lie on a disk of 16 MB; only root can make one."""
    disk = tmp_path / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=16m", "tmpfs", str(disk)]
    if os.geteuid() != 0 or subprocess.run(command, capture_output=True, check=False).returncode != 0:
        pytest.skip("a small disk cannot be mounted here")
    bench = Bench(conninfo, disk)
    yield bench
    bench.close()
    subprocess.run(["umount", str(disk)], check=True)


def fill(bench: Bench, leave_bytes: int) -> Path:
    """Take room on the disk until so much is left."""
    ballast = bench.folder / "ballast"
    facts = os.statvfs(bench.folder)
    with ballast.open("wb") as handle:
        try:
            handle.write(bytes(max(0, facts.f_bavail * facts.f_frsize - leave_bytes)))
        except OSError:
            assert leave_bytes == 0
    return ballast


def test_below_the_floor_jobs_wait(bench: Bench) -> None:
    ballast = fill(bench, 2 * MIB)
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


def test_a_job_that_meets_a_full_disk_goes_on_from_its_checkpoint(bench: Bench) -> None:
    bench.worker(FLOOR_BYTES=str(4 * MIB))
    job_id = bench.submit(options=bench.held())
    bench.wait_at_gate(job_id)
    ballast = fill(bench, 0)
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
