"""Paused queues hand out nothing, drained workers take nothing new; both outlive restarts."""

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from octasplat.workers.db.holds import set_queue_paused, set_worker_drained
from tests.support.worker_harness import WorkerHarness

QUICK = {"steps": 1, "seconds": 0.0}


@pytest.fixture
def bench(conninfo: str, tmp_path: Path) -> Iterator[WorkerHarness]:
    bench = WorkerHarness(conninfo, tmp_path)
    yield bench
    bench.close()


@pytest.mark.exhaustive
def test_paused_queue_hands_out_nothing_and_another_one_does(bench: WorkerHarness) -> None:
    bench.run_query(lambda c: set_queue_paused(c, "cpu", True))
    worker = bench.worker(queues="cpu,other")
    held = bench.submit(options=QUICK)
    assert bench.wait_until_finished(bench.submit(queue="other", options=QUICK)).state == "succeeded"
    time.sleep(1.0)  # several looks at the queue
    assert (bench.job(held).state, bench.job(held).attempt) == ("queued", 0)
    worker.send_signal(signal.SIGTERM)  # it leaves at once, also while it waits
    assert worker.wait(60) == 0
    bench.worker(queues="cpu,other")  # and the queue is still paused for the next one
    assert bench.wait_until_finished(bench.submit(queue="other", options=QUICK)).state == "succeeded"
    assert bench.job(held).state == "queued"
    bench.run_query(lambda c: set_queue_paused(c, "cpu", False))
    finished = bench.wait_until_finished(held)
    assert (finished.state, finished.attempt, finished.rescues) == ("succeeded", 1, 0)


@pytest.mark.exhaustive
def test_drained_worker_finishes_what_it_has_and_others_take_the_rest(bench: WorkerHarness) -> None:
    bench.worker(name="one")
    first = bench.submit(options=bench.wait_until_held())
    bench.wait_at_gate(first)
    bench.run_query(lambda c: set_worker_drained(c, "one", True))
    second = bench.submit(options=QUICK)
    bench.open_gate()
    assert bench.wait_until_finished(first).state == "succeeded"
    time.sleep(1.0)
    assert bench.job(second).state == "queued"
    bench.worker(name="two")
    assert bench.wait_until_finished(second).state == "succeeded"
    assert bench.job(second).worker in (None, "two")
    bench.run_query(lambda c: set_worker_drained(c, "one", False))
    bench.run_query(lambda c: set_worker_drained(c, "two", True))
    third = bench.submit(options=QUICK)
    assert bench.wait_until_finished(third).state == "succeeded"
