"""Jobs survive whatever happens to those who do them."""

import os
import signal
import sys
import uuid
from pathlib import Path

import psutil
import psycopg
import pytest

from tests.support.worker_harness import (
    MAX_WAIT_SECONDS,
    ROOT,
    WorkerHarness,
    child_pids,
    is_alive,
    wait_for_end,
)

TAKEN_OVER_SECONDS = 20.0
"""After 2.4 s a worker is missed; the rest is for a machine that is busy."""


SOON = {"STALE_SECONDS": "3"}


def starts(bench: WorkerHarness, job_id: uuid.UUID) -> list[int]:
    """The steps at which the attempts of a finished job began."""
    return [int(line) for line in bench.results(job_id)["history.txt"].split()]


def test_job_succeeds_and_events_are_recorded(shared_bench: WorkerHarness) -> None:
    job_id = shared_bench.submit(options={"steps": 12, "seconds": 0.01})
    job = shared_bench.wait_until_finished(job_id)
    assert (job.state, job.attempt, job.rescues, job.step, job.error) == ("succeeded", 1, 0, 12, None)
    assert shared_bench.results(job_id) == {"sum.txt": b"78", "history.txt": b"0\n"}
    states = [event.data["state"] for event in shared_bench.events(job_id) if event.kind == "state"]
    assert states == ["queued", "running", "succeeded"]
    assert "the toy begins at 0" in shared_bench.log(job_id)
    assert not any((shared_bench.folder / "work-w" / "attempts").iterdir())


def test_killed_worker_ends_child_and_job_is_recovered(bench: WorkerHarness) -> None:
    first = bench.worker(name="first", **SOON)
    job_id = bench.submit(options=bench.wait_until_held())
    bench.wait_at_gate(job_id)
    (child,) = child_pids(first)
    bench.worker(name="second", **SOON)
    bench.wait_until_up("second")
    first.kill()
    job = bench.wait(job_id, lambda job: job.worker == "second", TAKEN_OVER_SECONDS)
    assert not is_alive(child)
    assert (job.attempt, job.rescues) == (2, 1)
    bench.open_gate()
    assert bench.wait_until_finished(job_id).state == "succeeded"
    assert starts(bench, job_id) == [0, 30]
    assert bench.results(job_id)["sum.txt"] == str(sum(range(61))).encode()


def test_killed_child_is_started_again_from_the_checkpoint(shared_bench: WorkerHarness) -> None:
    (worker,) = shared_bench.processes
    job_id = shared_bench.submit(options=shared_bench.wait_until_held())
    shared_bench.wait_at_gate(job_id)
    os.kill(child_pids(worker)[0], signal.SIGKILL)
    shared_bench.open_gate()
    job = shared_bench.wait_until_finished(job_id)
    assert (job.state, job.attempt) == ("succeeded", 2)
    assert starts(shared_bench, job_id) == [0, 30]
    rescued = [event.data for event in shared_bench.events(job_id) if event.kind == "rescued"]
    assert len(rescued) == 1 and "signal 9" in rescued[0]["reason"]


@pytest.mark.exhaustive
def test_frozen_worker_is_fenced_on_return(bench: WorkerHarness) -> None:
    first = bench.worker(name="first", **SOON)
    job_id = bench.submit(options=bench.wait_until_held())
    bench.wait_at_gate(job_id)
    (child,) = child_pids(first)
    first.send_signal(signal.SIGSTOP)
    bench.worker(name="second", **SOON)
    bench.wait(job_id, lambda job: job.worker == "second" and job.attempt == 2)
    assert is_alive(child)  # the ghost's child goes on working
    first.send_signal(signal.SIGCONT)
    wait_for_end(child)
    bench.open_gate()
    job = bench.wait_until_finished(job_id)
    assert (job.state, job.attempt, job.worker) == ("succeeded", 2, "second")
    events = bench.events(job_id)
    taken = next(event.number for event in events if event.data.get("worker") == "second")
    assert all(event.attempt == 2 for event in events if event.number > taken)
    assert sum(event.data.get("state") == "succeeded" for event in events) == 1
    assert first.poll() is None  # the worker itself is fit for other jobs


def test_crashing_job_fails_with_reason(shared_bench: WorkerHarness) -> None:
    job_id = shared_bench.submit(options={"steps": 10, "seconds": 0.01, "crash_at": 7})
    job = shared_bench.wait_until_finished(job_id)
    assert (job.state, job.attempt, job.rescues) == ("failed", 4, 3)
    assert job.error is not None and job.error["type"] == "crashed"
    assert "signal 11" in job.error["message"] and "4 times" in job.error["message"]


@pytest.mark.exhaustive
def test_job_killing_its_worker_fails(bench: WorkerHarness) -> None:
    """The rescue counts, as no worker lives to do so."""
    bench.worker(queues="", name="care", **SOON)
    job_id = bench.submit(options={"steps": 100_000, "seconds": 0.02, "checkpoint_every": 1_000_000})
    for _ in range(4):
        worker = bench.worker(name="victim", **SOON)
        bench.wait(job_id, lambda job: job.state == "running")
        worker.kill()
        worker.wait()
        bench.wait(job_id, lambda job: job.state != "running")
    job = bench.job(job_id)
    assert (job.state, job.attempt) == ("failed", 4)
    assert job.error is not None and job.error["type"] == "worker_lost"


def test_terminated_worker_hands_back_at_once(bench: WorkerHarness) -> None:
    first = bench.worker(name="first", STALE_SECONDS="600")
    job_id = bench.submit(options=bench.wait_until_held())
    bench.wait_at_gate(job_id)
    bench.worker(name="second", STALE_SECONDS="600")
    bench.wait_until_up("second")
    first.terminate()
    bench.wait(job_id, lambda job: job.worker == "second")  # long before anybody could miss the first
    assert first.wait(MAX_WAIT_SECONDS) == 0
    bench.open_gate()
    job = bench.wait_until_finished(job_id)
    assert (job.state, job.attempt, job.rescues) == ("succeeded", 2, 0)
    assert starts(bench, job_id) == [0, 35]
    assert [event.kind for event in bench.events(job_id)].count("handed_back") == 1


def test_cancelled_job_resumes_when_retried(shared_bench: WorkerHarness) -> None:
    (worker,) = shared_bench.processes
    job_id = shared_bench.submit(options=shared_bench.wait_until_held())
    shared_bench.wait_at_gate(job_id)
    assert shared_bench.cancel(job_id).state == "canceling"
    assert shared_bench.cancel(job_id).state in ("canceling", "canceled")
    job = shared_bench.wait_until_finished(job_id)
    assert (job.state, job.error) == ("canceled", None) and child_pids(worker) == []
    assert shared_bench.cancel(job_id).state == "canceled"
    shared_bench.open_gate()
    assert shared_bench.retry(job_id).state == "queued"
    assert shared_bench.wait_until_finished(job_id).state == "succeeded"
    assert starts(shared_bench, job_id) == [0, 35]


def test_retry_from_the_start_forgets_the_checkpoint(shared_bench: WorkerHarness) -> None:
    job_id = shared_bench.submit(options=shared_bench.wait_until_held())
    shared_bench.wait_at_gate(job_id)
    shared_bench.cancel(job_id)
    shared_bench.wait_until_finished(job_id)
    shared_bench.open_gate()
    shared_bench.retry(job_id, fresh=True)
    assert shared_bench.wait_until_finished(job_id).state == "succeeded"
    assert starts(shared_bench, job_id) == [0]


@pytest.mark.exhaustive
def test_unresponsive_program_is_killed_after_grace(bench: WorkerHarness) -> None:
    worker = bench.worker(GRACE_SECONDS="0.5")
    job_id = bench.submit(options={"steps": 100_000, "deaf": True})
    bench.wait(job_id, lambda job: job.step is not None and job.step > 0)
    bench.cancel(job_id)
    assert bench.wait_until_finished(job_id).state == "canceled"
    assert child_pids(worker) == []


def test_queued_job_is_cancelled_without_a_worker(bench: WorkerHarness) -> None:
    job_id = bench.submit()
    assert bench.cancel(job_id).state == "canceled"
    other = bench.submit(options={"steps": 1})
    bench.worker()
    assert bench.wait_until_finished(other).state == "succeeded"
    assert bench.job(job_id).attempt == 0


@pytest.mark.exhaustive
def test_silent_program_is_tried_once_more(bench: WorkerHarness) -> None:
    bench.worker(SILENT_SECONDS="0.8")
    job_id = bench.submit(options={"steps": 20, "silent_at": 15, "checkpoint_every": 5})
    job = bench.wait_until_finished(job_id)
    # On a busy machine a program may be killed before it begins; the attempt that gets further forgives that.
    assert (job.state, job.rescues) == ("failed", 1) and job.attempt >= 2
    assert job.error is not None and job.error["type"] == "silent" and "2 times" in job.error["message"]


@pytest.mark.exhaustive
def test_program_exceeding_memory_limit_is_stopped(bench: WorkerHarness) -> None:
    bench.worker(MEMORY_LIMIT_BYTES=str(400 << 20))
    job_id = bench.submit(options={"steps": 1000, "hog_bytes": 600 << 20})
    job = bench.wait_until_finished(job_id)
    assert (job.state, job.attempt) == ("failed", 1)
    assert job.error is not None and job.error["type"] == "memory_limit"


@pytest.mark.parametrize(
    ("options", "type_", "message"),
    [
        ({"refuse": True}, "dataset_error", "The toy refuses this scene; send another."),
        ({"fault": True}, "unexpected", "RuntimeError: a fault of the program"),
    ],
)
def test_deterministic_failure_is_not_retried(
    shared_bench: WorkerHarness, options: dict[str, bool], type_: str, message: str
) -> None:
    job_id = shared_bench.submit(options=options)
    job = shared_bench.wait_until_finished(job_id)
    assert (job.state, job.attempt, job.error) == ("failed", 1, {"type": type_, "message": message})
    assert ("Traceback" in shared_bench.log(job_id)) == (type_ == "unexpected")


def test_results_published_before_a_crash_are_adopted(shared_bench: WorkerHarness) -> None:
    """A worker that died between publishing and saying so; the work is not done again."""
    job_id = shared_bench.submit(options={"steps": 5, "seconds": 0.01})
    shared_bench.wait_until_finished(job_id)
    with psycopg.connect(shared_bench.conninfo) as connection:
        connection.execute("DELETE FROM artifacts WHERE job_id = %s", [job_id])
        connection.execute(
            "UPDATE jobs SET state = 'running', heartbeat_at = now() - interval '1 hour', finished_at = NULL "
            "WHERE id = %s",
            [job_id],
        )
    job = shared_bench.wait(job_id, lambda job: job.is_over)
    assert (job.state, job.attempt) == ("succeeded", 2)
    assert shared_bench.results(job_id) == {"sum.txt": b"15", "history.txt": b"0\n"}


def test_jobs_run_by_priority_and_queue(bench: WorkerHarness) -> None:
    low = bench.submit(options={"steps": 2}, priority=-5)
    high = bench.submit(options={"steps": 2}, priority=5)
    elsewhere = bench.submit(options={"steps": 2}, queue="large")
    bench.worker()
    bench.wait_until_finished(low)
    assert bench.job(high).started_at < bench.job(low).started_at  # type: ignore[operator]
    assert bench.job(elsewhere).state == "queued"
    bench.worker(queues="large", name="large")
    assert bench.wait_until_finished(elsewhere).worker == "large"


def test_job_log_has_stages_and_causes_without_paths(shared_bench: WorkerHarness) -> None:
    job_id = shared_bench.submit(options={"tell_paths": True})
    job = shared_bench.wait_until_finished(job_id)
    assert job.error == {"type": "dataset_error", "message": "cache/pixels.bin cannot be read."}
    lines = shared_bench.log(job_id).splitlines()
    print_ = "[x.cc:12] Cannot open:cache/pixels.bin, cache/pixels.bin; see https://example.org/home/x"
    lines.remove(print_)  # comes by another way, so perhaps a moment later
    assert lines == [
        "Attempt 1",
        "Loading",
        "Warning: images/a b.jpg is dark; …/support/toy_kind.py says so.",
        "Loaded in 2.0 s",
        "Caused by FileNotFoundError: [Errno 2] No such file or directory: 'cache/pixels.bin'",
        "Failed: cache/pixels.bin cannot be read.",
    ]
    told = repr([event.data for event in shared_bench.events(job_id)])
    assert "images/a b.jpg is dark" in told and str(shared_bench.folder) not in told

    fault = shared_bench.submit(options={"fault": True})
    shared_bench.wait_until_finished(fault)
    log = shared_bench.log(fault)
    assert 'File "…/support/toy_kind.py"' in log and "RuntimeError: a fault of the program" in log
    assert str(ROOT) not in log and str(shared_bench.folder) not in log and sys.prefix not in log


def test_flood_of_log_lines_is_cut(shared_bench: WorkerHarness) -> None:
    (worker,) = shared_bench.processes
    shared_bench.wait_until_up("w")
    before = psutil.Process(worker.pid).memory_info().rss
    job_id = shared_bench.submit(options={"steps": 2, "log_lines": 500_000})
    assert shared_bench.wait_until_finished(job_id).state == "succeeded"
    lines = shared_bench.log(job_id).splitlines()
    assert len(lines) <= 20_001 and any("the rest is left out" in line for line in lines)
    assert [line for line in lines if "library" not in line and "(More" not in line] == [
        "Attempt 1", "the toy begins at 0", "Training", "Trained 2 iterations in 1.0 s", "Succeeded"
    ]  # fmt: skip
    assert psutil.Process(worker.pid).memory_info().rss - before < 40 << 20


def test_child_environment_has_no_secrets(shared_bench: WorkerHarness) -> None:
    (worker,) = shared_bench.processes
    job_id = shared_bench.submit(options={"steps": 100_000})
    shared_bench.wait(job_id, lambda job: job.step is not None)
    environment = Path(f"/proc/{child_pids(worker)[0]}/environ").read_bytes()
    assert b"DATABASE_URL" not in environment and b"SECRET" not in environment
    assert b"PATH=" in environment
    shared_bench.cancel(job_id)
    shared_bench.wait_until_finished(job_id)
