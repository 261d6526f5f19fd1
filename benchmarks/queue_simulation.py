"""Jobs in blocks without work: thousands of them, workers that are killed, and whether anything is lost.

    python -m benchmarks.queue_simulation --roots 20 --blocks 500 --processes 5 --workers 4 --kills 60

Prints a report as JSON; exit code 1 if there are faults. Workers take jobs as real ones do (fair choice,
claim, fenced success, recovery) but do no work. They share processes, some of which are killed (SIGKILL) at
any moment and started again. What must hold at the end:

* every job is done, and told of it once;
* each whole was put back into the queue once by its blocks, and found the result of each of them;
* nothing is left in the queue, and nothing waits for anything.

The database is a private one that does not flush.
"""

import argparse
import asyncio
import contextlib
import hashlib
import json
import os
import random
import resource
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import uuid
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, LiteralString

import psutil
import psycopg

from benchmarks.queue_deliveries import QUEUE, empty_database
from octasplat.engine.core import versions
from octasplat.workers.db.connections import Pool, open_pool
from octasplat.workers.queue.attempts import Attempt, FencedError
from octasplat.workers.queue.block_jobs import NewBlock, settle_root
from octasplat.workers.queue.block_results import files_from_others
from octasplat.workers.queue.claims import claim
from octasplat.workers.queue.fair_share import choose_job
from octasplat.workers.queue.job_results import ResultFile
from octasplat.workers.queue.jobs import NewJob, create_job
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue
from octasplat.workers.queue.recovery import StalledAttempts, recover_stalled_jobs
from octasplat.workers.queue.storage_leases import storage_lease
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.worker.heartbeat import DATABASE_ERRORS

HEARTBEAT_SECONDS = 1.0
STALE_SECONDS = 15.0
MAX_WORK_SECONDS = 0.02
"""Of each attempt, at random, so that kills meet it at any point."""
_FAULTS: dict[str, LiteralString] = {
    "jobs that have not succeeded": "SELECT count(*) FROM jobs WHERE state <> 'succeeded'",
    "jobs that succeeded other than once": """
        SELECT count(*) FROM (
            SELECT job_id FROM job_events WHERE kind = 'state' AND data->>'state' = 'succeeded'
            GROUP BY job_id HAVING count(*) <> 1) AS found
        """,
    "jobs without the event of their success": """
        SELECT count(*) FROM jobs WHERE NOT EXISTS (
            SELECT FROM job_events WHERE job_id = jobs.id AND kind = 'state' AND data->>'state' = 'succeeded')
        """,
    "wholes that were not released once": """
        SELECT count(*) FROM jobs WHERE role = 'root' AND cardinality(continuations) <> 1
        """,
    "wholes whose blocks were not all told of": """
        SELECT count(*) FROM jobs AS root WHERE role = 'root' AND (
            SELECT count(DISTINCT data->>'block') FROM job_events
            WHERE job_id = root.id AND kind = 'block_finished'
        ) <> (SELECT count(*) FROM jobs WHERE root_id = root.id)
        """,
    "results of wholes with another content than that of their blocks": """
        SELECT count(*) FROM artifacts JOIN jobs ON jobs.id = job_id
        WHERE role = 'root' AND sha256 <> options->>'expected'
        """,
    "wholes without a result": """
        SELECT count(*) FROM jobs WHERE role = 'root'
            AND NOT EXISTS (SELECT FROM artifacts WHERE job_id = jobs.id)
        """,
    "needs that are left": "SELECT count(*) FROM job_needs",
    # The entry of a worker that was killed just after a job's success lies there until it is pruned.
    "entries that are left": "SELECT count(*) FROM procrastinate_jobs WHERE status = 'todo'",
}


def digest(text: str) -> str:
    """Return the SHA-256 of a text."""
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass
class SimulatedWorker:
    """A worker that does no work.

    Args:
        pool: connections.
        folder: of the store.
        log: a file for the times of its deliveries, one JSON object a line.
    """

    pool: Pool
    folder: Path
    log: Path
    queue: ProcrastinateQueue = field(init=False)

    def __post_init__(self) -> None:
        self.queue = ProcrastinateQueue(
            self.pool, heartbeat_seconds=HEARTBEAT_SECONDS, stale_seconds=STALE_SECONDS, poll_seconds=0.5
        )

    async def run(self) -> None:
        """Take jobs until killed."""
        recovery = asyncio.create_task(self._recover())
        try:
            await self.queue.consume(QUEUE, 1, self._deliver)
        finally:
            recovery.cancel()

    async def _recover(self) -> None:
        stalled = StalledAttempts(2 * HEARTBEAT_SECONDS)
        while True:
            await asyncio.sleep(random.uniform(1.0, 2.0) * HEARTBEAT_SECONDS)
            with contextlib.suppress(*DATABASE_ERRORS):
                await recover_stalled_jobs(self.pool, self.queue, STALE_SECONDS, stalled)

    async def _deliver(self, job_id: uuid.UUID, entry_id: int) -> None:
        begun = time.perf_counter()
        chosen = await choose_job(self.pool, self.queue, job_id, entry_id)
        if chosen is None:
            return
        attempt = await claim(self.pool, *chosen, "worker")
        if attempt is None:
            return
        claimed = time.perf_counter()
        await asyncio.sleep(random.uniform(0.0, MAX_WORK_SECONDS))
        worked = time.perf_counter()
        try:
            kind = await self._work(attempt)
        except FencedError:
            return
        if attempt.job.root_id is not None:
            async with self.pool.connection() as connection:
                await settle_root(connection, self.queue, attempt.job.root_id)
        taken = {"begin": claimed - begun, "end": time.perf_counter() - worked, "kind": kind}
        with self.log.open("a") as file:
            file.write(json.dumps(taken) + "\n")

    async def _work(self, attempt: Attempt) -> str:
        """Do what an attempt is for, and end it; returns which of the three it was."""
        job = attempt.job
        if job.root_id is not None:
            text = f"{job.root_id} {job.options['number']}"
            name = f"blocks/{job.options['number']:06d}"
            result = ResultFile(name, digest(text), 1000, "application/octet-stream")
            await attempt.succeed([result], job_queue=self.queue)
            return "block"
        if job.role is None:
            blocks = [NewBlock(n, 10, {"number": n}) for n in range(1, int(job.options["blocks"]) + 1)]
            plan = {"attempt": job.attempt, "step": 1, "files": [], "results": versions.RESULTS_VERSION}
            async with storage_lease(self.pool, LocalStorage(self.folder, floor_bytes=0)) as lease:
                await attempt.start_blocks(
                    self.queue, plan, "block", blocks, lease, first_steps=1, total_steps=10 * len(blocks)
                )
            return "plan"
        async with self.pool.connection() as connection:
            files = await files_from_others(connection, job)
        found = digest(" ".join(file.sha256 for file in files))
        result = ResultFile("scene.ply", found, 1000, "application/octet-stream")
        await attempt.succeed([result], job_queue=self.queue)
        return "merge"


async def work(conninfo: str, folder: Path, log: Path, count: int) -> None:
    """Be so many workers."""
    async with open_pool(conninfo, max_size=4 * count) as pool, asyncio.TaskGroup() as group:
        for _ in range(count):
            group.create_task(SimulatedWorker(pool, folder, log).run())


async def queue_roots(conninfo: str, roots: int, blocks: int, owners: int) -> None:
    """Queue the jobs that will be in blocks."""
    async with open_pool(conninfo, max_size=2) as pool, pool.connection() as connection:
        for number in range(roots):
            new = NewJob(f"owner{number % owners}", "whole", {"blocks": blocks}, QUEUE)
            job = await create_job(connection, ProcrastinateQueue(), new)
            contents = " ".join(digest(f"{job.id} {n}") for n in range(1, blocks + 1))
            await connection.execute(
                "UPDATE jobs SET options = options || jsonb_build_object('expected', %s::text) WHERE id = %s",
                [digest(contents), job.id],
            )


@dataclass
class Simulation:
    """What runs.

    Args:
        conninfo: the database.
        database: folder of its data.
        folder: for the store and the logs.
        processes: how many.
        workers: in each of them.
        seed: decides who is killed and when.
    """

    conninfo: str
    database: Path
    folder: Path
    processes: int
    workers: int
    seed: int
    killed: int = 0
    peak_memory: int = 0
    database_cpu_seconds: float = 0.0
    _processes: list["subprocess.Popen[bytes]"] = field(default_factory=list)

    def run(self, kills: int, seconds_between: float) -> float:
        """Let the workers do everything; returns the seconds that it took."""
        chance = random.Random(self.seed)
        self._processes = [self._start(number) for number in range(self.processes)]
        begun = last = time.monotonic()
        try:
            with psycopg.connect(self.conninfo, autocommit=True) as connection:
                while _number(connection, "SELECT count(*) FROM jobs WHERE state <> 'succeeded'"):
                    if self.killed < kills and time.monotonic() - last >= seconds_between:
                        last = time.monotonic()
                        self._kill(chance.randrange(self.processes))
                    self._look_at_database()
                    time.sleep(0.2)
        finally:
            ended = time.monotonic()
            for process in self._processes:
                process.send_signal(signal.SIGKILL)
                process.wait()
        return ended - begun

    def _start(self, number: int) -> "subprocess.Popen[bytes]":
        command = ["-m", "benchmarks.queue_simulation", "--work", str(self.folder)]
        size = ["--workers", str(self.workers)]
        log = self.folder / f"worker-{number}.jsonl"
        with (self.folder / f"worker-{number}.log").open("ab") as errors:
            return subprocess.Popen(
                [sys.executable, *command, str(log), *size],
                env={**os.environ, "DATABASE_URL": self.conninfo},
                stderr=errors,
            )

    def _kill(self, number: int) -> None:
        self._processes[number].kill()
        self._processes[number].wait()
        self._processes[number] = self._start(number)
        self.killed += 1

    def _look_at_database(self) -> None:
        """Note the memory of all its processes, what they share counted once, and the CPU time so far."""
        memory, seconds = 0, 0.0
        postmaster = int((self.database / "cluster" / "postmaster.pid").read_text().split()[0])
        server = psutil.Process(postmaster)
        for process in (server, *server.children()):
            with contextlib.suppress(psutil.Error):
                memory += process.memory_full_info().pss
                times = process.cpu_times()
                seconds += times.user + times.system
        times = server.cpu_times()
        self.database_cpu_seconds = seconds + times.children_user + times.children_system
        self.peak_memory = max(self.peak_memory, memory)

    def times(self) -> dict[str, dict[str, float]]:
        """Return milliseconds of what a delivery takes of the queue, by what the attempt was for."""
        lines = [
            json.loads(line)
            for path in sorted(self.folder.glob("worker-*.jsonl"))
            for line in path.read_text().splitlines()
            if line.endswith("}")  # a killed worker may have left half a line
        ]
        found = {}
        for kind in ("plan", "block", "merge"):
            sums = sorted(1000 * (line["begin"] + line["end"]) for line in lines if line["kind"] == kind)
            if len(sums) > 1:
                tail = statistics.quantiles(sums, n=100)[-1]
                found[kind] = {
                    "median": round(statistics.median(sums), 1),
                    "99 %": round(min(tail, sums[-1]), 1),
                    "slowest": round(sums[-1], 1),
                }
        return found


def _number(connection: psycopg.Connection, query: LiteralString) -> int:
    row = connection.execute(query).fetchone()
    assert row is not None
    return int(row[0])


def report(simulation: Simulation, seconds: float) -> dict[str, Any]:
    """Return what came out; ``faults`` is empty if everything holds."""
    with psycopg.connect(simulation.conninfo, autocommit=True) as connection:
        faults = {name: _number(connection, query) for name, query in _FAULTS.items()}
        jobs = _number(connection, "SELECT count(*) FROM jobs")
        rescued = _number(connection, "SELECT count(*) FROM job_events WHERE kind = 'rescued'")
        size = _number(connection, "SELECT pg_database_size(current_database())")
        attempts = _number(connection, "SELECT sum(attempt) FROM jobs")
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "jobs": jobs,
        "attempts": attempts,
        "kills": simulation.killed,
        "attempts lost by kills": rescued,
        "seconds": round(seconds, 1),
        "attempts per second": round(attempts / seconds, 1),
        "CPU milliseconds per attempt": {
            "database": round(1000 * simulation.database_cpu_seconds / attempts, 1),
            "worker": round(1000 * (children.ru_utime + children.ru_stime) / attempts, 1),
        },
        "milliseconds of the queue": simulation.times(),
        "memory of the database, MB": round(simulation.peak_memory / 1e6),
        "size of the database, MB": round(size / 1e6),
        "faults": {name: count for name, count in faults.items() if count},
    }


def main() -> None:
    """Parse the command line, simulate and print the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--roots", type=int, default=20)
    parser.add_argument("--blocks", type=int, default=500, help="of each root")
    parser.add_argument("--owners", type=int, default=4)
    parser.add_argument("--processes", type=int, default=5)
    parser.add_argument("--workers", type=int, default=4, help="in each process")
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--seconds-between", type=float, default=2.0, help="two kills")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--work", nargs=2, metavar=("FOLDER", "LOG"), help="be workers")
    arguments = parser.parse_args()
    if arguments.work:
        folder, log = arguments.work
        asyncio.run(work(os.environ["DATABASE_URL"], Path(folder), Path(log), arguments.workers))
        return
    with tempfile.TemporaryDirectory(prefix="octasplat-queue-") as name:
        folder = Path(name)
        folder.chmod(0o711)
        server, conninfo = empty_database(folder / "data", connections=200)
        try:
            asyncio.run(queue_roots(conninfo, arguments.roots, arguments.blocks, arguments.owners))
            (folder / "store").mkdir()
            simulation = Simulation(
                conninfo,
                server.home,
                folder / "store",
                arguments.processes,
                arguments.workers,
                arguments.seed,
            )
            found = report(simulation, simulation.run(arguments.kills, arguments.seconds_between))
        finally:
            server.stop()
    print(json.dumps(found, indent=2))
    sys.exit(1 if found["faults"] else 0)


if __name__ == "__main__":
    main()
