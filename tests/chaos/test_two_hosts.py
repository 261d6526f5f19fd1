"""Two workers that share a database and an S3 store only: the second goes on where the first one died."""

import signal
import time
from pathlib import Path

import pytest

from benchmarks.chaos import journal_faults
from benchmarks.chaos_kind import ChainOptions, undisturbed
from tests.support.stored_dataset import store_dataset
from tests.support.two_hosts import TAKEN_OVER_SECONDS, Hosts, two
from tests.support.worker_harness import child_pids, is_alive

__all__ = ["two"]

pytestmark = pytest.mark.heavy

KIND = "benchmarks.chaos_kind"
STEPS = 40
PHOTOGRAPHS = {"images/a.png": b"not looked at by this kind", "images/b.png": b"x" * 100_000}


@pytest.mark.exhaustive
@pytest.mark.parametrize("how", ["dead", "cut off"])
def test_job_of_disconnected_host_is_recovered_by_second_host(two: Hosts, tmp_path: Path, how: str) -> None:
    bench = two.bench
    for path, content in PHOTOGRAPHS.items():
        (tmp_path / "scene" / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "scene" / path).write_bytes(content)
    first = two.worker(0, KIND)
    options = ChainOptions(seed=1, steps=STEPS, seconds=0.05, gate=str(bench.gate))
    job_id = bench.submit(
        "chain", dataset_id=store_dataset(bench, tmp_path / "scene"), options=options.model_dump()
    )
    kept = bench.wait(job_id, lambda job: (job.checkpoint or {}).get("step", 0) >= STEPS // 2, 90).checkpoint
    assert kept is not None
    (child,) = child_pids(first)
    second = two.worker(1, KIND)
    while "takes" not in (bench.folder / "host1.log").read_text():
        assert second.poll() is None
        time.sleep(0.1)
    two.found[0].disconnect()
    if how == "dead":
        first.send_signal(signal.SIGKILL)
    died = time.monotonic()
    bench.wait(job_id, lambda job: job.worker == "host1", 40)
    seconds = time.monotonic() - died
    assert seconds <= TAKEN_OVER_SECONDS, bench.worker_logs()
    # The first has let go by itself, or there would be two at work by now.
    assert not is_alive(child)
    bench.wait(job_id, lambda _: any(e.kind == "resumed" for e in bench.events(job_id)), 20)
    if how == "cut off":
        two.found[0].reconnect()
    bench.open_gate()
    job = bench.wait_until_finished(job_id, 120)
    assert (job.state, job.attempt, job.rescues, job.worker) == ("succeeded", 2, 0, "host1")
    events = [
        {"id": e.number, "kind": e.kind, "attempt": e.attempt, "data": e.data} for e in bench.events(job_id)
    ]
    assert journal_faults(events) == []
    resumed = next(event for event in events if event["kind"] == "resumed")
    assert resumed["data"]["step"] >= kept["step"] and resumed["data"]["attempt"] == 1
    assert bench.results(job_id) == {"chain.bin": undisturbed(PHOTOGRAPHS, options)}
    print(f"taken over {seconds:.1f} s after the first was {how}")  # noqa: T201 - shown on request
