"""A worker that is cut off from the database looks after its child and lets go before others take over."""

import contextlib
import os
import signal
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest

from tests.support.worker_harness import MAX_WAIT_SECONDS, WorkerHarness, child_pids, wait_for_end

STALE_SECONDS = 8.0
LONG = {"STALE_SECONDS": "600"}
"""Cut off for shorter than anybody minds."""


@pytest.fixture
def bench(conninfo: str, tmp_path: Path) -> Iterator[WorkerHarness]:
    bench = WorkerHarness(conninfo, tmp_path / "bench", stale_seconds=3.0)
    bench.folder.mkdir()
    yield bench
    bench.close()


@contextlib.contextmanager
def held_row(bench: WorkerHarness, job_id: uuid.UUID) -> Iterator[None]:
    """Somebody else has the job's lock: its row can be read and not written."""
    with psycopg.connect(bench.conninfo) as connection:
        connection.execute("SELECT 1 FROM jobs WHERE id = %s FOR UPDATE", [job_id])
        yield


@contextlib.contextmanager
def frozen_database(bench: WorkerHarness) -> Iterator[None]:
    """Every server process of this database is silent, as behind a cable that was pulled."""
    with psycopg.connect(bench.conninfo) as connection:
        rows = connection.execute(
            "SELECT pid FROM pg_stat_activity WHERE datname = current_database() AND pid <> pg_backend_pid()"
        ).fetchall()
    name = psycopg.conninfo.conninfo_to_dict(bench.conninfo)["dbname"]
    admin = psycopg.conninfo.make_conninfo(bench.conninfo, dbname="postgres")
    with psycopg.connect(admin, autocommit=True) as connection:
        connection.execute(f'ALTER DATABASE "{name}" ALLOW_CONNECTIONS false')
        for (pid,) in rows:
            os.kill(pid, signal.SIGSTOP)
        try:
            yield
        finally:
            for (pid,) in rows:
                os.kill(pid, signal.SIGCONT)
            connection.execute(f'ALTER DATABASE "{name}" ALLOW_CONNECTIONS true')


@pytest.mark.exhaustive
def test_lost_database_stops_the_child_before_others_take_over(bench: WorkerHarness) -> None:
    worker = bench.worker(name="before", STALE_SECONDS=str(STALE_SECONDS))
    job_id = bench.submit(options=bench.wait_until_held())
    bench.wait_at_gate(job_id)
    (child,) = child_pids(worker)
    with bench.disconnect_database():
        wait_for_end(child, STALE_SECONDS)
        assert worker.wait(MAX_WAIT_SECONDS) == 69  # to be started again
    bench.worker(name="after", queues="cpu")
    bench.wait(job_id, lambda job: job.worker == "after" and job.attempt == 2)
    bench.open_gate()
    assert bench.wait_until_finished(job_id).state == "succeeded"
    assert next(e.data["step"] for e in bench.events(job_id) if e.kind == "resumed") >= 30


@pytest.mark.exhaustive
def test_unresponsive_child_of_draining_worker_is_killed_before_stale_limit(bench: WorkerHarness) -> None:
    worker = bench.worker(STALE_SECONDS=str(STALE_SECONDS), GRACE_SECONDS="600")
    job_id = bench.submit(options=bench.wait_until_held(deaf=True))
    bench.wait_at_gate(job_id)
    (child,) = child_pids(worker)
    worker.terminate()
    while "does not heed" not in bench.log(job_id):
        time.sleep(0.05)
    with bench.disconnect_database():
        wait_for_end(child, STALE_SECONDS)


@pytest.mark.exhaustive
def test_reading_state_does_not_renew_heartbeat(bench: WorkerHarness) -> None:
    """The row can be read all the time; only the missing heartbeats tell that others may take over."""
    worker = bench.worker(STALE_SECONDS=str(STALE_SECONDS))
    job_id = bench.submit(options=bench.wait_until_held())
    bench.wait_at_gate(job_id)
    (child,) = child_pids(worker)
    with held_row(bench, job_id):
        wait_for_end(child, STALE_SECONDS)


@pytest.mark.exhaustive
def test_unresponsive_database_counts_as_lost(bench: WorkerHarness) -> None:
    worker = bench.worker(STALE_SECONDS=str(STALE_SECONDS))
    job_id = bench.submit(options=bench.wait_until_held())
    bench.wait_at_gate(job_id)
    (child,) = child_pids(worker)
    with frozen_database(bench):
        wait_for_end(child, STALE_SECONDS)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("options", "settings", "type_"),
    [
        ({"hog_behind_gate_bytes": 600 << 20}, {"MEMORY_LIMIT_BYTES": str(400 << 20)}, "memory_limit"),
        ({"silent_behind_gate": True}, {"SILENT_SECONDS": "5"}, "silent"),
    ],
)
def test_job_limits_apply_while_disconnected(
    bench: WorkerHarness, options: dict[str, object], settings: dict[str, str], type_: str
) -> None:
    worker = bench.worker(**LONG, **settings)
    job_id = bench.submit(options=bench.wait_until_held(**options))
    bench.wait_at_gate(job_id)
    (child,) = child_pids(worker)
    with bench.disconnect_database():
        bench.open_gate()
        wait_for_end(child)
    # The verdict is told when there is somebody to tell.
    told = bench.wait(job_id, lambda job: job.error is not None or job.rescues > 0)
    if type_ == "memory_limit":
        assert told.error is not None and told.error["type"] == type_ and told.state == "failed"
    else:
        reasons = [e.data["reason"] for e in bench.events(job_id) if e.kind == "rescued"]
        assert "said nothing" in reasons[0]


@pytest.mark.exhaustive
def test_cancelled_unresponsive_child_is_killed_while_disconnected(bench: WorkerHarness) -> None:
    worker = bench.worker(**LONG, GRACE_SECONDS="2")
    job_id = bench.submit(options=bench.wait_until_held(deaf=True))
    bench.wait_at_gate(job_id)
    (child,) = child_pids(worker)
    bench.cancel(job_id)
    while "does not heed" not in bench.log(job_id):
        time.sleep(0.05)
    with bench.disconnect_database():
        wait_for_end(child)
    assert bench.wait_until_finished(job_id).state == "canceled"
