"""Limits of a job's time and memory, kept by the worker."""

import uuid
from itertools import pairwise

import psutil
import pytest

from octasplat.workers.db.workers import live_workers
from tests.support.worker_harness import MAX_WAIT_SECONDS, WorkerHarness


def attempts(bench: WorkerHarness, job_id: uuid.UUID) -> list[float]:
    """For how long each attempt had the job, in seconds."""
    told = [event for event in bench.events(job_id) if event.kind == "state"]
    pairs = [(a, b) for a, b in pairwise(told) if a.data["state"] == "running"]
    return [(end.at - start.at).total_seconds() for start, end in pairs]


@pytest.mark.exhaustive
def test_job_time_limit_fails_and_retry_restarts_clock(bench: WorkerHarness) -> None:
    """The time counts over all attempts of a try."""
    hours = str(6 / 3600)
    first = bench.worker(name="first", MAX_JOB_HOURS=hours)
    job_id = bench.submit(options={"steps": 100_000, "checkpoint_every": 10})
    bench.wait(job_id, lambda job: job.checkpoint is not None)
    first.terminate()
    assert first.wait(MAX_WAIT_SECONDS) == 0
    bench.worker(name="second", MAX_JOB_HOURS=hours)
    job = bench.wait_until_finished(job_id)
    assert job.state == "failed" and job.error is not None and job.error["type"] == "time_limit"
    assert job.checkpoint is not None and job.attempt == 2
    assert [event.kind for event in bench.events(job_id)].count("resumed") == 1
    early, late = attempts(bench, job_id)
    assert early + late >= 6 > early
    bench.retry(job_id)
    again = bench.wait_until_finished(job_id)
    assert again.error is not None and again.error["type"] == "time_limit" and again.attempt == 3
    assert attempts(bench, job_id)[2] >= 6
    assert again.checkpoint is not None and again.checkpoint["step"] > job.checkpoint["step"]


def test_job_that_is_done_before_it_stops_for_its_time_succeeds(bench: WorkerHarness) -> None:
    bench.worker(MAX_JOB_HOURS=str(1 / 3600), GRACE_SECONDS="120")
    job_id = bench.submit(options=bench.wait_until_held(deaf=True))
    bench.wait(job_id, lambda _job: "does not heed" in bench.log(job_id))
    bench.open_gate()
    job = bench.wait_until_finished(job_id)
    assert job.state == "succeeded" and job.error is None
    assert bench.results(job_id)["sum.txt"] == str(sum(range(61))).encode()


def test_memory_is_shared_out_by_default(bench: WorkerHarness) -> None:
    bench.worker(queues="cpu=2")
    bench.wait_until_up("w")
    job_id = bench.submit(options={"steps": 1})
    assert bench.wait_until_finished(job_id).state == "succeeded"
    [worker] = bench.run_query(lambda connection: live_workers(connection, 20))
    limit, total = worker.facts["memory_limit_bytes"], psutil.virtual_memory().total
    assert 0 < limit < total / 2 and {"glb", "spz"} <= set(worker.facts["formats"])


@pytest.mark.exhaustive
def test_job_that_cannot_be_watched_is_stopped(bench: WorkerHarness) -> None:
    bench.worker(KIND_MODULES='["tests.support.broken_watch"]')
    job = bench.wait_until_finished(bench.submit(options={"steps": 100_000, "checkpoint_every": 1_000_000}))
    assert job.state == "failed" and job.error is not None and job.error["type"] == "unwatched"
    assert job.attempt == 4 and "no such file in /proc" in bench.worker_logs()
