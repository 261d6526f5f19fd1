"""Starts real workers and asks the database about their jobs."""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import psycopg
from psycopg.rows import class_row

from octasplat.workers.db.connections import Connection, open_pool, select_columns
from octasplat.workers.db.rows import Artifact, Job, JobEvent
from octasplat.workers.queue.block_jobs import cancel_job
from octasplat.workers.queue.jobs import NewJob, artifacts_of, create_job, retry_job
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue
from octasplat.workers.storage.factory import open_storage
from tests.support.releases import ROOT, Release

FAST = {
    "HEARTBEAT_SECONDS": "0.4",
    "RESCUE_SECONDS": "0.3",
    "POLL_SECONDS": "0.15",
    "GRACE_SECONDS": "8",
    "FLOOR_BYTES": "0",
    "THREADS": "1",
    "KIND_MODULES": '["tests.support.toy_kind"]',
}
MAX_WAIT_SECONDS = 300.0
"""Nothing is expected to take so long; on a busy machine all takes many times longer than on an idle one."""


@dataclass
class WorkerHarness:
    """Workers on one database and one store.

    Args:
        conninfo: the database.
        folder: for the store, the work and the logs.
        stale_seconds: after how long others take the jobs of a worker that is not heard of; soon where that
            is what is tested, as a busy machine may keep any worker from saying anything for a while.
        store: its address; empty for one in the folder.
    """

    conninfo: str
    folder: Path
    stale_seconds: float = 60.0
    processes: list["subprocess.Popen[bytes]"] = field(default_factory=list)
    store: str = ""

    def __post_init__(self) -> None:
        self.store = self.store or str(self.folder / "store")

    @property
    def gate(self) -> Path:
        """The file that toys wait for; beside the folder, as that may be on a disk that is full."""
        return self.folder.with_name(f"{self.folder.name}.gate")

    def worker(
        self, *, queues: str = "cpu", name: str = "w", release: Release | None = None, **settings: str
    ) -> "subprocess.Popen[bytes]":
        """Start a worker in a process, of an installed release or of the sources."""
        given = {
            **FAST,
            **({} if release is None else {"KIND_MODULES": '["toy_kind"]'}),
            "STALE_SECONDS": str(self.stale_seconds),
            "STORAGE": self.store,
            "WORK": str(self.folder / f"work-{name}"),
        }
        given.update(settings)
        environment = {
            **os.environ,
            **{f"OCTASPLAT_{key}": value for key, value in given.items()},
            "DATABASE_URL": self.conninfo,
            "PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT)]) if release is None else "",
            "OMP_NUM_THREADS": "1",
            "NUMBA_NUM_THREADS": "2",
            "A_SECRET_TOKEN": "must not reach the child",
        }
        python = sys.executable if release is None else str(release.python)
        command = [python, "-m", "octasplat", "worker", "--queues", queues, "--name", name]
        with (self.folder / f"{name}.log").open("ab") as log:
            process = subprocess.Popen(
                command, env=environment, cwd=ROOT if release is None else self.folder, stderr=log
            )
        self.processes.append(process)
        return process

    def close(self) -> None:
        """End what still runs."""
        for process in self.processes:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
            process.wait(10)

    def submit(self, kind: str = "toy", **values: Any) -> uuid.UUID:
        """Queue a job."""
        fields = {"owner": "me", "queue": "cpu", "options": {}, **values}
        return self.run_query(lambda c: create_job(c, ProcrastinateQueue(), NewJob(kind=kind, **fields))).id

    def cancel(self, job_id: uuid.UUID) -> Job:
        """Cancel a job."""
        return self.run_query(lambda c: cancel_job(c, ProcrastinateQueue(), job_id))

    def retry(self, job_id: uuid.UUID, *, fresh: bool = False) -> Job:
        """Queue a job again."""
        return self.run_query(lambda c: retry_job(c, ProcrastinateQueue(), job_id, from_start=fresh))

    def run_query(self, what: Callable[[Connection], Any]) -> Any:
        """Run a function of the queue on a connection."""

        async def run() -> Any:
            async with open_pool(self.conninfo, max_size=2) as pool, pool.connection() as connection:
                return await what(connection)

        return asyncio.run(run())

    def job(self, job_id: uuid.UUID) -> Job:
        """The job as it is."""
        with psycopg.connect(self.conninfo) as connection:
            return _read_job(connection, job_id)

    def events(self, job_id: uuid.UUID) -> list[JobEvent]:
        """What happened to the job."""
        with psycopg.connect(self.conninfo) as connection:
            cursor = connection.cursor(row_factory=class_row(JobEvent))
            query = select_columns("SELECT {} FROM job_events WHERE job_id = %s ORDER BY id", JobEvent)
            cursor.execute(query, [job_id])
            return cursor.fetchall()

    def log(self, job_id: uuid.UUID) -> str:
        """The job's log."""
        with psycopg.connect(self.conninfo) as connection:
            rows = connection.execute("SELECT text FROM job_logs WHERE job_id = %s ORDER BY id", [job_id])
            return "\n".join(text for (text,) in rows)

    def results(self, job_id: uuid.UUID) -> dict[str, bytes]:
        """Contents of the job's results by name."""
        storage = open_storage(self.store)
        artifacts: list[Artifact] = self.run_query(lambda c: artifacts_of(c, job_id))
        return {a.name: b"".join(storage.read(a.sha256)) for a in artifacts}

    def wait(self, job_id: uuid.UUID, ready: Callable[[Job], bool], seconds: float = MAX_WAIT_SECONDS) -> Job:
        """Wait until the job is as asked for."""
        deadline = time.monotonic() + seconds
        # One connection for all looks: each new one costs the server a process.
        with psycopg.connect(self.conninfo, autocommit=True) as connection:
            while not ready(job := _read_job(connection, job_id)):
                assert time.monotonic() < deadline, f"{job}\n{self.worker_logs()}"
                time.sleep(0.05)
        return job

    def wait_until_finished(self, job_id: uuid.UUID, seconds: float = MAX_WAIT_SECONDS) -> Job:
        """Wait until the job is over."""
        return self.wait(job_id, lambda job: job.is_over, seconds)

    def wait_until_held(self, **options: Any) -> dict[str, Any]:
        """Options of a toy that has checkpoints at 10, 20 and 30 and waits at 35 for :meth:`open_gate`."""
        slow = {"steps": 60, "seconds": 0.01, "checkpoint_every": 10}
        return {**slow, "hold_at": 35, "gate": str(self.gate), **options}

    def wait_at_gate(self, job_id: uuid.UUID) -> Job:
        """Wait until such a toy is there, and its checkpoint kept."""
        return self.wait(
            job_id, lambda job: job.state == "running" and (job.checkpoint or {}).get("step") == 30
        )

    def open_gate(self) -> None:
        """Let toys go on."""
        self.gate.touch()

    def wait_until_up(self, name: str) -> None:
        """Wait until a worker takes jobs."""
        deadline = time.monotonic() + MAX_WAIT_SECONDS
        while f"worker {name} takes" not in (self.folder / f"{name}.log").read_text(errors="replace"):
            assert time.monotonic() < deadline, self.worker_logs()
            time.sleep(0.05)

    @contextlib.contextmanager
    def disconnect_database(self) -> Iterator[None]:
        """Nobody has a connection to the database, and none is given."""
        name = psycopg.conninfo.conninfo_to_dict(self.conninfo)["dbname"]
        admin = psycopg.conninfo.make_conninfo(self.conninfo, dbname="postgres")
        with psycopg.connect(admin, autocommit=True) as connection:
            connection.execute(f'ALTER DATABASE "{name}" ALLOW_CONNECTIONS false')
            connection.execute(
                "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = %s", [name]
            )
            try:
                yield
            finally:
                connection.execute(f'ALTER DATABASE "{name}" ALLOW_CONNECTIONS true')

    def worker_logs(self) -> str:
        """What the workers said."""
        return "\n".join(path.read_text(errors="replace")[-3000:] for path in self.folder.glob("*.log"))


def _read_job(connection: "psycopg.Connection[Any]", job_id: uuid.UUID) -> Job:
    cursor = connection.cursor(row_factory=class_row(Job))
    job = cursor.execute(select_columns("SELECT {} FROM jobs WHERE id = %s", Job), [job_id]).fetchone()
    assert job is not None
    return job


def child_pids(worker: "subprocess.Popen[bytes]") -> list[int]:
    """Processes that a worker has started."""
    found = Path(f"/proc/{worker.pid}/task/{worker.pid}/children").read_text().split()
    return [int(pid) for pid in found]


def kill_tree(worker: "subprocess.Popen[bytes]") -> None:
    """Kill a worker and all that it has started, and what these have, at once."""
    pids = [worker.pid]
    for pid in pids:
        with contextlib.suppress(FileNotFoundError):
            pids += map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split())
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def is_alive(pid: int) -> bool:
    """Whether a process runs; a zombie does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):  # before it is opened, or before it is read
        return False


def wait_for_end(pid: int, seconds: float = MAX_WAIT_SECONDS) -> float:
    """Wait until a process is gone; returns how long that took in seconds."""
    began = time.monotonic()
    while is_alive(pid):
        assert time.monotonic() - began < seconds, f"process {pid} lives on after {seconds:g} s"
        time.sleep(0.02)
    return time.monotonic() - began
