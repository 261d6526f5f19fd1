"""A machine that cannot do jobs takes none, says so, and burns none; when it is well again it goes on."""

import os
import time
from typing import Any

import pytest

from octasplat.workers.db.workers import live_workers
from tests.support.worker_harness import MAX_WAIT_SECONDS, WorkerHarness


def wait_until_it_ails(bench: WorkerHarness, what: str) -> None:
    deadline = time.monotonic() + MAX_WAIT_SECONDS
    while not (ailing := facts(bench).get("ailing")) or what not in ailing:
        assert time.monotonic() < deadline, bench.worker_logs()
        time.sleep(0.05)


def facts(bench: WorkerHarness) -> dict[str, Any]:
    rows = bench.run_query(lambda connection: live_workers(connection, 60.0))
    return dict(rows[0].facts) if rows else {}


def test_unusable_work_folder_does_not_count_against_jobs(bench: WorkerHarness) -> None:
    blocked = bench.folder / "blocked"
    blocked.touch()
    bench.worker(WORK=str(blocked / "work"), RECOVER_SECONDS="0.2")
    jobs = [bench.submit(options={"steps": 2}) for _ in range(2)]
    wait_until_it_ails(bench, "work cannot be used")
    assert all((bench.job(job).state, bench.job(job).rescues) == ("queued", 0) for job in jobs)
    assert "takes no jobs" in bench.worker_logs()
    blocked.unlink()
    for job in jobs:
        over = bench.wait_until_finished(job)
        assert (over.state, over.attempt, over.rescues) == ("succeeded", 1, 0)


@pytest.mark.exhaustive
def test_broken_library_does_not_count_against_jobs(
    bench: WorkerHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = bench.folder / "cache"
    cache.mkdir()
    monkeypatch.setitem(os.environ, "XDG_CACHE_HOME", str(cache))
    bench.worker(RECOVER_SECONDS="0.5")
    bench.wait_until_up("w")
    (cache / "broken").touch()
    jobs = [bench.submit(options={"steps": 2}) for _ in range(2)]
    wait_until_it_ails(bench, "a library is broken on this machine")
    for job in jobs:
        row = bench.wait(job, lambda row: row.state == "queued")
        assert row.rescues == 0 and row.attempt <= 1
    (cache / "broken").unlink()
    assert all(
        (over := bench.wait_until_finished(job)).state == "succeeded" and over.rescues == 0 for job in jobs
    )
    assert "the worker's machine is at fault" in bench.log(jobs[0]).lower()


@pytest.mark.exhaustive
def test_host_with_repeated_crashes_pauses(bench: WorkerHarness) -> None:
    bench.worker(RECOVER_SECONDS="0.4")
    crashing = [bench.submit(owner=owner, options={"crash_at": 1}) for owner in ("me", "you", "me")]
    fine = bench.submit(options={"steps": 2})
    assert all(bench.wait_until_finished(job).state == "failed" for job in crashing)
    assert bench.wait_until_finished(fine).state == "succeeded"
    logs = (bench.folder / "w.log").read_text()
    assert "takes no jobs: the programs of 3 jobs, of several owners, crashed in a row" in logs
    assert "is well again" in logs
