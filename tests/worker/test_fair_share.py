"""Owners take turns, however many jobs each of them has queued."""

import pytest

from octasplat.workers.queue.fair_share import queue_position
from tests.support.worker_harness import WorkerHarness


@pytest.mark.exhaustive
def test_owners_alternate_and_keep_their_order(bench: WorkerHarness) -> None:
    bench.worker()
    first = bench.submit(owner="a", options=bench.wait_until_held())
    bench.wait_at_gate(first)
    names = ("a1", "a2", "a3", "a4", "b1", "b2", "c1")
    quick = {"steps": 1, "seconds": 0.0}
    jobs = {name: bench.submit(owner=name[0], label=name, options=quick) for name in names}
    urgent = bench.submit(owner="a", label="a0", priority=5, options=quick)
    places = [bench.run_query(lambda c, n=name: queue_position(c, bench.job(jobs[n]))) for name in names]
    assert places == [3, 5, 6, 7, 0, 3, 1]
    bench.open_gate()
    assert all(bench.wait_until_finished(job).state == "succeeded" for job in (first, urgent, *jobs.values()))
    rows = sorted((bench.job(job) for job in (urgent, *jobs.values())), key=lambda job: job.started_at)
    assert [row.label for row in rows] == ["b1", "c1", "a0", "b2", "a1", "a2", "a3", "a4"]
    assert all((row.attempt, row.rescues) == (1, 0) for row in rows)
