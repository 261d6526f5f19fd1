"""While a service is brought up to date, two versions of it work side by side and lose nothing."""

import asyncio
import io
import os
import re
import subprocess
import sys
import tarfile
import time
import urllib.request
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest

from octasplat.engine.core import versions
from octasplat.workers.db.connections import Connection
from octasplat.workers.db.migrate import migrate
from octasplat.workers.postgres.embedded import EmbeddedPostgres
from octasplat.workers.queue.jobs import NewJob, cancel_job, create_job
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue
from tests.support import lock_order_check
from tests.support.postgres_fixtures import copied_database
from tests.support.service_harness import BEARER, TOKEN, committed_dataset, running_service
from tests.support.worker_harness import MAX_WAIT_SECONDS, ROOT, WorkerHarness

PREVIOUS = "6f3bf281170c"
"""The commit of the release before this one; it is installed from the repository."""
STALE_SECONDS = 6.0
"""After which others take a dead worker's jobs, and by half of which a busy machine does not hold one up."""


@pytest.fixture
def bench(conninfo: str, tmp_path: Path) -> Iterator[WorkerHarness]:
    lock_order_check.remove_lock_order_checks(conninfo)  # the version before keeps to no order
    bench = WorkerHarness(conninfo, tmp_path, stale_seconds=STALE_SECONDS)
    yield bench
    bench.close()


@pytest.fixture
def previous(tmp_path: Path) -> Path:
    """The folder of the release before this one."""
    folder = tmp_path / "previous"
    command = ["git", "archive", PREVIOUS, "engine", "workers", "service", "src", "tests/work"]
    try:
        made = subprocess.run(command, cwd=ROOT, capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip(f"the commit {PREVIOUS} is not here")
    with tarfile.open(fileobj=io.BytesIO(made.stdout)) as archive:
        archive.extractall(folder, filter="data")
    return folder


def results_version(folder: Path) -> int:
    """The number of the results that the release in ``folder`` gives."""
    source = (folder / "engine" / "versions.py").read_text(encoding="utf-8")
    found = re.search(r"^RESULTS = (\d+)$", source, re.MULTILINE)
    assert found is not None
    return int(found[1])


async def submit_many(connection: Connection) -> list[uuid.UUID]:
    """Jobs of others, of a kind that only a later version knows."""
    new = NewJob(owner="you", kind="later", options={"steps": 3}, queue="cpu")
    return [(await create_job(connection, ProcrastinateQueue(), new)).id for _ in range(16)]


async def cancel_many(connection: Connection, jobs: list[uuid.UUID]) -> None:
    for job_id in jobs:
        await cancel_job(connection, ProcrastinateQueue(), job_id)


def starts(bench: WorkerHarness, job_id: object) -> list[int]:
    """The steps at which the attempts of a finished job began."""
    return [int(line) for line in bench.results(job_id)["history.txt"].split()]  # type: ignore[arg-type]


def test_unknown_job_is_left_to_newer_worker(bench: WorkerHarness) -> None:
    old = bench.worker(name="old", STALE_SECONDS="60")
    bench.wait_until_up("old")
    many = bench.run_query(submit_many)
    later = bench.submit("later", options={"steps": 3})
    shaded = bench.submit(options={"steps": 3, "shade": 0.5})
    plain = bench.submit(options={"steps": 3})
    assert bench.wait_until_finished(plain).worker == "old"  # what it knows it does meanwhile
    deadline = time.monotonic() + MAX_WAIT_SECONDS
    while (bench.folder / "old.log").read_text().count("leaves job") < len(many) + 2:
        assert time.monotonic() < deadline, bench.worker_logs()
        time.sleep(0.05)
    bench.run_query(lambda connection: cancel_many(connection, many))
    for job_id in (later, shaded):
        job = bench.job(job_id)
        assert (job.state, job.attempt, job.rescues) == ("queued", 0, 0)
        assert [event.kind for event in bench.events(job_id)] == ["state"]
    old.terminate()
    assert old.wait(MAX_WAIT_SECONDS) == 0
    bench.worker(name="new", STALE_SECONDS="60", KIND_MODULES='["tests.support.next_version_toy"]')
    for job_id in (later, shaded):
        job = bench.wait_until_finished(job_id)
        assert (job.state, job.attempt, job.rescues, job.worker) == ("succeeded", 1, 0, "new")


def test_versions_with_other_results_are_not_mixed(bench: WorkerHarness) -> None:
    first = bench.worker(name="first")
    job_id = bench.submit(options=bench.wait_until_held())
    bench.wait_at_gate(job_id)
    bench.worker(name="later", KIND_MODULES='["tests.support.next_version_results"]')
    second = bench.worker(name="second")
    for name in ("later", "second"):
        bench.wait_until_up(name)
    first.kill()
    bench.wait(job_id, lambda job: job.worker == "second")  # the one that can go on with it
    bench.wait(job_id, lambda _job: "the toy begins at 30" in bench.log(job_id))
    second.kill()
    bench.wait(job_id, lambda job: job.worker == "later")
    bench.open_gate()
    assert bench.wait_until_finished(job_id).state == "succeeded"
    assert starts(bench, job_id) == [0] and "begins anew" in bench.log(job_id)


def test_previous_release_works_beside_current(
    postgres: EmbeddedPostgres, previous: Path, tmp_path: Path
) -> None:
    """Each resumes what the other began if their results are the same; the earlier front end answers."""
    with copied_database(postgres, "template0") as conninfo:
        bench = WorkerHarness(conninfo, tmp_path, stale_seconds=STALE_SECONDS)
        environment = {**os.environ, "DATABASE_URL": conninfo, "PYTHONPATH": str(previous / "src")}
        settings = {
            "DATA": str(tmp_path),
            "PORT": "0",
            "STORAGE": str(tmp_path / "store"),
            "FLOOR_BYTES": "0",
            "TOKEN": TOKEN,
        }
        front = subprocess.Popen(
            [sys.executable, "-m", "octasplat", "api"],
            cwd=previous,
            env={**environment, **{f"OCTASPLAT_{name}": value for name, value in settings.items()}},
            stdout=subprocess.PIPE,
        )
        assert front.stdout is not None
        try:
            address = front.stdout.readline().decode().strip()  # its tables are there
            old = bench.worker(name="old", root=previous)
            bench.wait_until_up("old")
            migrate(conninfo)  # beside the front end and the worker of the earlier release
            gates = [str(tmp_path / f"gate-{number}") for number in range(3)]
            begun = bench.submit(options=bench.wait_until_held(gate=gates[0]))
            bench.wait_at_gate(begun)
            bench.worker(name="old-too", root=previous)
            stays = bench.submit(options=bench.wait_until_held(gate=gates[1]))
            bench.wait_at_gate(stays)

            new = bench.worker(name="new")
            bench.wait_until_up("new")
            old.kill()
            # Only the other old worker is free for what the killed one had begun.
            handed_back = bench.submit(options=bench.wait_until_held(gate=gates[2]))
            bench.wait_at_gate(handed_back)
            assert bench.job(handed_back).worker == "new"
            Path(gates[1]).touch()
            assert bench.wait_until_finished(stays).worker == "old-too"
            bench.wait(begun, lambda job: job.worker == "old-too")
            Path(gates[0]).touch()
            assert bench.wait_until_finished(begun).state == "succeeded" and starts(bench, begun) == [0, 30]
            asked = urllib.request.Request(f"{address}/v1/jobs/{begun}", headers=BEARER)
            with urllib.request.urlopen(asked, timeout=30) as answer:
                assert b'"succeeded"' in answer.read()

            new.kill()
            bench.wait(handed_back, lambda job: job.worker == "old-too")
            Path(gates[2]).touch()
            done = bench.wait_until_finished(handed_back)
            has_same_results = results_version(previous) == versions.RESULTS_VERSION
            begun_at = [0, 30] if has_same_results else [0]
            assert (done.state, starts(bench, handed_back)) == ("succeeded", begun_at)
            assert ("begins anew" in bench.log(handed_back)) != has_same_results
        finally:
            front.terminate()
            front.wait(30)
            front.stdout.close()
            bench.close()


async def test_previous_release_takes_jobs_of_current_front_end(
    postgres: EmbeddedPostgres, previous: Path, tmp_path: Path
) -> None:
    """Settings that only the current version knows are default, and so no reason to leave the job."""
    with copied_database(postgres, "template0") as conninfo:
        await asyncio.to_thread(migrate, conninfo)
        bench = WorkerHarness(conninfo, tmp_path, stale_seconds=STALE_SECONDS)
        try:
            async with running_service(conninfo, tmp_path) as (http, service):
                body = {
                    "kind": "reconstruct",
                    "dataset_id": await committed_dataset(service),
                    "options": {"train": {"iterations": 50}},
                }
                job = (await http.post("/v1/jobs", json=body)).json()
                await asyncio.to_thread(bench.worker, name="old", root=previous)
                async with asyncio.timeout(MAX_WAIT_SECONDS):
                    while (now := (await http.get(f"/v1/jobs/{job['id']}")).json())["attempt"] == 0:
                        await asyncio.sleep(0.1)
                assert now["worker"] == "old" and now["options"]["train"]["iterations"] == 50
        finally:
            await asyncio.to_thread(bench.close)
