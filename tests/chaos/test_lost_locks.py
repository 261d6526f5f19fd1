"""A host that vanished in the midst of a write does not hold its job for ever."""

import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from octasplat.workers.db.locks import ROW_SECONDS
from tests.support.worker_harness import ROOT, WorkerHarness

pytestmark = pytest.mark.heavy

HOLDER = """
import asyncio, sys, time, uuid
from octasplat.workers.db.connections import open_pool
from octasplat.workers.queue.jobs import get_job

async def hold():
    async with open_pool(sys.argv[1], max_size=1) as pool, pool.connection() as connection:
        async with connection.transaction():
            await get_job(connection, uuid.UUID(sys.argv[2]), lock=True)
            print("held", flush=True)
            time.sleep(600)

asyncio.run(hold())
"""


@pytest.fixture
def bench(conninfo: str, tmp_path: Path) -> Iterator[WorkerHarness]:
    bench = WorkerHarness(conninfo, tmp_path, stale_seconds=3.0)
    yield bench
    bench.close()


@pytest.mark.exhaustive
def test_job_recovers_after_lock_holder_vanishes(bench: WorkerHarness) -> None:
    first = bench.worker(name="first")
    job_id = bench.submit(options={"steps": 100, "seconds": 0.05})
    bench.wait(job_id, lambda job: job.checkpoint is not None)
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLDER, bench.conninfo, str(job_id)], cwd=ROOT, stdout=subprocess.PIPE
    )
    try:
        assert holder.stdout is not None and holder.stdout.readline() == b"held\n"
        held = time.monotonic()
        first.kill()
        bench.worker(name="second")
        bench.wait(job_id, lambda job: job.worker == "second", ROW_SECONDS + 200)
        assert time.monotonic() - held >= ROW_SECONDS - 1
        assert bench.wait_until_finished(job_id).state == "succeeded"
    finally:
        holder.kill()
        holder.wait()
        assert holder.stdout is not None
        holder.stdout.close()
