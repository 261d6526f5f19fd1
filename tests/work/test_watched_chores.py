"""What a worker does regularly is done again after a failure, or it ends; nobody waits for who is gone."""

import asyncio
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import psycopg
import pytest
from worker_bench import PATIENCE_SECONDS, ROOT, Bench

from octasplat.workers.records.database import IDLE_SECONDS, STATEMENT_SECONDS, open_pool
from octasplat.workers.records.datasets import create_dataset, put_file
from octasplat.workers.records.workers import live_workers

FROZEN = """
import asyncio, os, signal, sys, uuid
import octasplat.workers.records.database as database
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


@pytest.fixture
def bench(conninfo: str, tmp_path: Path) -> Iterator[Bench]:
    bench = Bench(conninfo, tmp_path)
    yield bench
    bench.close()


def renamed(bench: Bench, before: str, after: str) -> None:
    with psycopg.connect(bench.conninfo) as connection:
        connection.execute(f"ALTER TABLE {before} RENAME TO {after}".encode())


def seen(bench: Bench) -> bool:
    return bool(bench.do(lambda connection: live_workers(connection, 1.0)))


def test_a_chore_that_failed_is_done_again_and_one_that_never_works_ends_the_worker(bench: Bench) -> None:
    worker = bench.worker(HEARTBEAT_SECONDS="0.2")
    bench.up("w")
    log = bench.folder / "w.log"
    renamed(bench, "workers", "hidden")
    deadline = time.monotonic() + PATIENCE_SECONDS
    while "say_alive failed" not in log.read_text():
        assert time.monotonic() < deadline and worker.poll() is None, bench.worker_logs()
        time.sleep(0.02)
    renamed(bench, "hidden", "workers")
    while not seen(bench):
        assert time.monotonic() < deadline and worker.poll() is None, bench.worker_logs()
        time.sleep(0.05)
    job = bench.submit(options=bench.held(steps=100_000))
    bench.wait_at_gate(job)
    renamed(bench, "workers", "hidden")
    assert worker.wait(PATIENCE_SECONDS) == 69, bench.worker_logs()
    assert "failed 10 times in a row" in log.read_text()
    assert (bench.job(job).state, bench.job(job).rescues) == ("queued", 0)


def test_progress_takes_bounded_room(bench: Bench) -> None:
    job = bench.submit(options=bench.held(steps=40))
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
    deadline = time.monotonic() + PATIENCE_SECONDS
    while len(kept := [e.data["step"] for e in bench.events(job) if e.kind == "progress"]) > 2000:
        assert time.monotonic() < deadline, bench.worker_logs()
        time.sleep(0.1)
    assert len(kept) >= 1000 and (kept[0], kept[-1]) == (1, 5000)
    assert max(later - earlier for earlier, later in pairwise(kept)) <= 5


@pytest.mark.parametrize("where", ["between statements", "between statements sent together"])
def test_who_freezes_within_a_transaction_keeps_nobody_waiting(conninfo: str, where: str) -> None:
    assert max(IDLE_SECONDS, STATEMENT_SECONDS) <= 60

    async def put() -> None:
        async with open_pool(conninfo) as pool, pool.connection() as connection:
            await put_file(connection, dataset.id, "images/a.png", "a" * 64, 1)

    async def make() -> None:
        nonlocal dataset
        async with open_pool(conninfo) as pool, pool.connection() as connection:
            dataset = await create_dataset(connection, "me", "d")

    dataset = None  # type: ignore[var-annotated]
    asyncio.run(make())
    command = [sys.executable, "-c", FROZEN, conninfo, str(dataset.id), where]
    process = subprocess.Popen(command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)})
    try:
        assert os.waitpid(process.pid, os.WUNTRACED)[1] == 0x7F | signal.SIGSTOP << 8
        asyncio.run(asyncio.wait_for(put(), PATIENCE_SECONDS))
    finally:
        process.kill()
        process.wait(10)
