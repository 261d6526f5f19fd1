"""What a worker does regularly is done again after a failure, or it ends; nobody waits for who is gone."""

import asyncio
import os
import signal
import subprocess
import sys
import time
from itertools import pairwise

import psycopg
import pytest

from octasplat.workers.db.connections import IDLE_SECONDS, STATEMENT_SECONDS, open_pool
from octasplat.workers.db.datasets import create_dataset, put_file
from octasplat.workers.db.workers import live_workers
from octasplat.workers.worker.periodic_tasks import (
    MAX_FAILURES,
    PeriodicTask,
    PeriodicTaskError,
    run_periodically,
)
from tests.support.worker_harness import MAX_WAIT_SECONDS, ROOT, WorkerHarness

FROZEN = """
import asyncio, os, signal, sys, uuid
import octasplat.workers.db.connections as database
database.IDLE_SECONDS = 1
database.TRANSACTION_SECONDS = 2

async def main():
    async with database.open_pool(sys.argv[1], max_size=2) as pool, pool.connection() as connection:
        async with connection.transaction():
            await connection.execute("SELECT 1 FROM datasets WHERE id = %s FOR UPDATE", [sys.argv[2]])
            if sys.argv[3] == "between statements sent together":
                connection.pgconn.enter_pipeline_mode()
                connection.pgconn.send_query_params(b"SELECT 1", None)
                connection.pgconn.send_flush_request()
                connection.pgconn.flush()
            os.kill(os.getpid(), signal.SIGSTOP)

asyncio.run(main())
"""


def renamed(bench: WorkerHarness, before: str, after: str) -> None:
    with psycopg.connect(bench.conninfo) as connection:
        connection.execute(f"ALTER TABLE {before} RENAME TO {after}".encode())


def seen(bench: WorkerHarness) -> bool:
    return bool(bench.run_query(lambda connection: live_workers(connection, 1.0)))


@pytest.mark.exhaustive
def test_periodic_task_is_retried_and_repeated_failure_ends_worker(bench: WorkerHarness) -> None:
    worker = bench.worker(HEARTBEAT_SECONDS="0.2")
    bench.wait_until_up("w")
    log = bench.folder / "w.log"
    renamed(bench, "workers", "hidden")
    deadline = time.monotonic() + MAX_WAIT_SECONDS
    while "send_heartbeat failed" not in log.read_text():
        assert time.monotonic() < deadline and worker.poll() is None, bench.worker_logs()
        time.sleep(0.02)
    renamed(bench, "hidden", "workers")
    while not seen(bench):
        assert time.monotonic() < deadline and worker.poll() is None, bench.worker_logs()
        time.sleep(0.05)
    job = bench.submit(options=bench.wait_until_held(steps=100_000))
    bench.wait_at_gate(job)
    renamed(bench, "workers", "hidden")
    assert worker.wait(MAX_WAIT_SECONDS) == 69, bench.worker_logs()
    assert "failed 10 times in a row" in log.read_text()
    assert (bench.job(job).state, bench.job(job).rescues) == ("queued", 0)


@pytest.mark.exhaustive
def test_progress_events_are_thinned(bench: WorkerHarness) -> None:
    job = bench.submit(options=bench.wait_until_held(steps=40))
    with psycopg.connect(bench.conninfo) as connection:
        connection.execute(
            """
            INSERT INTO job_events (job_id, attempt, kind, data)
            SELECT %s, 1, 'progress', jsonb_build_object('step', n) FROM generate_series(1, 5000) AS n
            """,
            [job],
        )
        connection.execute(
            "UPDATE jobs SET state = 'failed', slip = NULL, finished_at = now() WHERE id = %s", [job]
        )
    bench.worker(queues="")
    deadline = time.monotonic() + MAX_WAIT_SECONDS
    while len(kept := [e.data["step"] for e in bench.events(job) if e.kind == "progress"]) > 2000:
        assert time.monotonic() < deadline, bench.worker_logs()
        time.sleep(0.1)
    assert len(kept) >= 1000 and (kept[0], kept[-1]) == (1, 5000)
    assert max(later - earlier for earlier, later in pairwise(kept)) <= 5


@pytest.mark.parametrize("where", ["between statements", "between statements sent together"])
async def test_frozen_transaction_is_ended_by_timeout(conninfo: str, where: str) -> None:
    assert max(IDLE_SECONDS, STATEMENT_SECONDS) <= 60

    async with open_pool(conninfo) as pool, pool.connection() as connection:
        dataset = await create_dataset(connection, "me", "d")
    command = [sys.executable, "-c", FROZEN, conninfo, str(dataset.id), where]
    process = subprocess.Popen(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)})
    try:
        assert os.waitpid(process.pid, os.WUNTRACED)[1] == 0x7F | signal.SIGSTOP << 8
        async with (
            asyncio.timeout(MAX_WAIT_SECONDS),
            open_pool(conninfo) as pool,
            pool.connection() as connection,
        ):
            await put_file(connection, dataset.id, "images/a.png", "a" * 64, 1)
    finally:
        process.kill()
        process.wait(10)


async def test_repeated_timeouts_end_a_periodic_task() -> None:
    begun = 0

    async def hang() -> None:
        nonlocal begun
        begun += 1
        await asyncio.sleep(3600)

    with pytest.raises(PeriodicTaskError, match="hang did not end in time 10 times in a row"):
        async with asyncio.timeout(30):
            await run_periodically(PeriodicTask(hang, 0.001, timeout_seconds=0.01))
    assert begun == MAX_FAILURES


async def test_periodic_task_outlasts_lost_database() -> None:
    errors = [psycopg.OperationalError("gone"), TimeoutError("no route")] * MAX_FAILURES

    async def lose() -> None:
        if not errors:
            raise asyncio.CancelledError
        raise errors.pop()

    with pytest.raises(asyncio.CancelledError):
        await run_periodically(PeriodicTask(lose, 0.001))
    assert errors == []
