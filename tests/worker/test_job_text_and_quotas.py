"""What a job says or stores harms neither its worker nor other jobs."""

import time

import pytest

from octasplat.workers.storage.local import LocalStorage
from tests.support.worker_harness import WorkerHarness


def test_job_with_unstorable_text_succeeds(bench: WorkerHarness) -> None:
    worker = bench.worker(RECOVER_SECONDS="600")
    odd = bench.submit(options={"say_nul": True})
    fine = bench.submit(options={"steps": 2})
    job = bench.wait_until_finished(odd)
    assert (job.state, job.attempt, job.rescues) == ("failed", 1, 0)
    assert job.error is not None and job.error["message"] == "The header \ufffd \ufffd is odd."
    assert bench.wait_until_finished(fine).state == "succeeded"
    assert "takes no jobs" not in (bench.folder / "w.log").read_text() and worker.poll() is None


@pytest.mark.exhaustive
def test_results_beyond_the_quota_do_not_stay(bench: WorkerHarness) -> None:
    bench.worker(QUOTA_BYTES="1000000", COLLECT_SECONDS="1")
    jobs = [bench.submit(options={"steps": 1, "result_bytes": 2_000_000}) for _ in range(3)]
    for job_id in jobs:
        job = bench.wait_until_finished(job_id)
        assert job.state == "failed" and job.error is not None and job.error["type"] == "quota"
    storage = LocalStorage(bench.folder / "store", floor_bytes=0)
    # The job ends in the database first, and its list of results is taken out of the store then.
    deadline = time.monotonic() + 30
    folder = bench.folder / "store" / "documents" / "results"
    while list(storage.list_documents("results/")) or any(folder.iterdir()):
        assert time.monotonic() < deadline, "a failed job keeps its list of results"
        time.sleep(0.1)
    marked = bench.run_query(replaced)
    large = {entry.blob.sha256 for entry in storage.list_blobs() if entry.blob.size_bytes == 2_000_000}
    assert len(large) <= 3 and large <= marked  # they go within minutes


async def replaced(connection: object) -> set[str]:
    cursor = await connection.execute("SELECT sha256 FROM replaced_contents")  # type: ignore[attr-defined]
    return {row["sha256"] for row in await cursor.fetchall()}
