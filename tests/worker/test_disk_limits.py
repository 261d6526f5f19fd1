"""Jobs that fill disks themselves end, say why, and leave room; others go on."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from octasplat.workers.db.quotas import Quota, set_quota
from tests.support.small_disk import small_disk
from tests.support.worker_harness import WorkerHarness

MIB = 1 << 20


@pytest.fixture
def bench(conninfo: str, tmp_path: Path) -> Iterator[WorkerHarness]:
    """Workers whose store and work lie on a disk of 24 MB."""
    with small_disk(tmp_path / "disk", 24) as disk:
        bench = WorkerHarness(conninfo, disk)
        yield bench
        bench.close()


@pytest.mark.exhaustive
@pytest.mark.parametrize("floor_bytes", [0, 8 * MIB])
def test_job_filling_disk_fails(bench: WorkerHarness, floor_bytes: int) -> None:
    bench.worker(FLOOR_BYTES=str(floor_bytes), FULL_DISK_SECONDS="0.1")
    greedy = bench.submit(options={"steps": 40, "seconds": 0.1, "fill_bytes": 64 * MIB})
    other = bench.submit(options={"steps": 3})
    job = bench.wait_until_finished(greedy)
    assert job.state == "failed" and job.error is not None and job.error["type"] == "no_space", job
    assert job.attempt == 4 and "4 times without getting any further" in job.error["message"]
    assert bench.wait_until_finished(other).state == "succeeded"


def test_job_exceeding_every_host_fails_before_start(bench: WorkerHarness) -> None:
    bench.worker(FLOOR_BYTES=str(MIB))
    job = bench.wait_until_finished(bench.submit(options={"steps": 3}, estimate={"disk_bytes": 64 * MIB}))
    assert (job.state, job.attempt) == ("failed", 0) and job.error is not None
    assert job.error["type"] == "no_space" and f"at least {64 * MIB} bytes of disk" in job.error["message"]


@pytest.mark.exhaustive
def test_large_job_waits_for_space_while_others_run(bench: WorkerHarness) -> None:
    ballast = bench.folder / "ballast"
    ballast.write_bytes(bytes(12 * MIB))
    bench.worker(FLOOR_BYTES=str(MIB), FULL_DISK_SECONDS="0.5")
    large = bench.submit(options={"steps": 3}, estimate={"disk_bytes": 16 * MIB})
    assert bench.wait_until_finished(bench.submit(options={"steps": 3})).state == "succeeded"
    job = bench.job(large)
    assert (job.state, job.attempt) == ("queued", 0)
    assert [event.kind for event in bench.events(large)] == ["state"]
    ballast.unlink()
    job = bench.wait_until_finished(large)
    assert (job.state, job.attempt, job.rescues) == ("succeeded", 1, 0)


def test_workspace_beyond_limit_fails_job(bench: WorkerHarness) -> None:
    bench.worker(MAX_WORKSPACE_BYTES=str(4 * MIB))
    job = bench.wait_until_finished(
        bench.submit(options={"steps": 500, "seconds": 0.1, "fill_bytes": 8 * MIB})
    )
    assert job.state == "failed" and job.error is not None and job.error["type"] == "disk_limit", job
    assert f"{4 * MIB} are allowed" in job.error["message"] and job.attempt == 1


@pytest.mark.exhaustive
def test_results_beyond_quota_fail_job(bench: WorkerHarness) -> None:
    bench.run_query(lambda connection: set_quota(connection, "me", Quota(max_bytes=MIB)))
    bench.worker()
    job = bench.wait_until_finished(bench.submit(options={"steps": 3, "result_bytes": 2 * MIB}))
    assert job.state == "failed" and job.error is not None and job.error["type"] == "quota", job
    assert "delete datasets or jobs" in job.error["message"] and not bench.results(job.id)
    assert (
        bench.wait_until_finished(bench.submit(options={"steps": 3, "result_bytes": MIB // 2})).state
        == "succeeded"
    )
    # The settings' own limit holds for who has none.
    bench.worker(name="strict", queues="strict", QUOTA_BYTES=str(MIB))
    job = bench.wait_until_finished(
        bench.submit(owner="you", queue="strict", options={"steps": 3, "result_bytes": 2 * MIB})
    )
    assert job.state == "failed" and job.error is not None and job.error["type"] == "quota", job
