"""While a service is brought up to date, two versions of it work side by side and lose nothing."""

import asyncio
import json
import os
import subprocess
import time
import urllib.request
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psycopg
import pytest

from octasplat.workers.db.connections import Connection
from octasplat.workers.db.migrate import migrate
from octasplat.workers.postgres.embedded import EmbeddedPostgres
from octasplat.workers.queue.block_jobs import cancel_job
from octasplat.workers.queue.jobs import NewJob, create_job
from octasplat.workers.queue.procrastinate_queue import ProcrastinateQueue
from tests.support import lock_order_check
from tests.support.postgres_fixtures import copied_database
from tests.support.releases import Release, install_current, install_previous
from tests.support.service_harness import BEARER, api_environment, committed_dataset, running_service
from tests.support.worker_harness import MAX_WAIT_SECONDS, WorkerHarness

STALE_SECONDS = 6.0
"""After which others take a dead worker's jobs, and by half of which a busy machine does not hold one up."""


@pytest.fixture
def bench(conninfo: str, tmp_path: Path) -> Iterator[WorkerHarness]:
    lock_order_check.remove_lock_order_checks(conninfo)  # the version before keeps to no order
    bench = WorkerHarness(conninfo, tmp_path, stale_seconds=STALE_SECONDS)
    yield bench
    bench.close()


@pytest.fixture(scope="module")
def previous(tmp_path_factory: pytest.TempPathFactory) -> Release:
    return install_previous(tmp_path_factory.mktemp("previous"))


@pytest.fixture(scope="module")
def current(tmp_path_factory: pytest.TempPathFactory) -> Release:
    return install_current(tmp_path_factory.mktemp("current"))


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


@pytest.mark.exhaustive
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


@pytest.mark.exhaustive
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


@dataclass
class Service:
    """A service that is brought up to date, process by process: the front end and workers of two releases."""

    bench: WorkerHarness
    previous: Release
    current: Release
    front_end: "subprocess.Popen[bytes] | None" = None
    address: str = ""

    def migrate(self, release: Release) -> None:
        command = [release.python, "-m", "octasplat", "migrate"]
        environment = {**os.environ, "DATABASE_URL": self.bench.conninfo, "PYTHONPATH": ""}
        subprocess.run(command, cwd=self.bench.folder, env=environment, check=True, stdout=subprocess.DEVNULL)

    def start_front_end(self, release: Release) -> None:
        """Start the front end of a release in the place of the one that runs."""
        self.stop_front_end()
        environment = {
            **api_environment(self.bench.conninfo, self.bench.folder),
            "OCTASPLAT_STORAGE": str(self.bench.folder / "store"),
            "OCTASPLAT_KIND_MODULES": '["toy_kind"]',
            "PYTHONPATH": "",
        }
        command = [release.python, "-m", "octasplat", "api"]
        self.front_end = subprocess.Popen(
            command, cwd=self.bench.folder, env=environment, stdout=subprocess.PIPE
        )
        assert self.front_end.stdout is not None
        self.address = self.front_end.stdout.readline().decode().strip()

    def stop_front_end(self) -> None:
        if self.front_end is not None:
            assert self.front_end.stdout is not None
            self.front_end.terminate()
            self.front_end.wait(60)
            self.front_end.stdout.close()
            self.front_end = None

    def replace_worker(self, name: str, process: "subprocess.Popen[bytes]") -> "subprocess.Popen[bytes]":
        """Start a worker of the current release, and stop the earlier one as a rollout does."""
        started = self.bench.worker(name=name, release=self.current)
        self.bench.wait_until_up(name)
        process.terminate()
        assert process.wait(MAX_WAIT_SECONDS) == 0
        return started

    def ask(self, path: str, body: dict[str, Any] | None = None) -> bytes:
        data = None if body is None else json.dumps(body).encode()
        headers = {**BEARER, "Content-Type": "application/json"}
        asked = urllib.request.Request(f"{self.address}{path}", data=data, headers=headers)
        with urllib.request.urlopen(asked, timeout=60) as answer:
            return bytes(answer.read())

    def submit(self, **options: Any) -> uuid.UUID:
        with psycopg.connect(self.bench.conninfo) as connection:
            dataset = uuid.uuid4()
            query = (
                "INSERT INTO datasets (id, owner, name, state, photographs) "
                "VALUES (%s, 'local', 'x', 'committed', 8)"
            )
            connection.execute(query, [dataset])
        body = {"kind": "toy", "dataset_id": str(dataset), "options": options}
        return uuid.UUID(json.loads(self.ask("/v1/jobs", body))["id"])

    def submit_held(self, gate: Path) -> uuid.UUID:
        """Queue a job, and wait until it is held and its checkpoint stored, by columns that both know."""
        job_id = self.submit(**self.bench.wait_until_held(gate=str(gate)))
        query = "SELECT state = 'running' AND checkpoint['step'] = '30' FROM jobs WHERE id = %s"
        deadline = time.monotonic() + MAX_WAIT_SECONDS
        with psycopg.connect(self.bench.conninfo, autocommit=True) as connection:
            while connection.execute(query, [job_id]).fetchone() != (True,):
                assert time.monotonic() < deadline, self.bench.worker_logs()
                time.sleep(0.1)
        return job_id

    def check_succeeded(self, job_id: uuid.UUID, worker: str, begun_at: list[int]) -> None:
        """Check by the front end that a job ended well, where it did and where its attempts began."""
        assert self.bench.wait_until_finished(job_id).state == "succeeded"
        job = json.loads(self.ask(f"/v1/jobs/{job_id}"))
        assert (job["state"], self.bench.job(job_id).worker) == ("succeeded", worker)
        history = self.ask(f"/v1/jobs/{job_id}/artifacts/history.txt").decode()
        assert [int(line) for line in history.split()] == begun_at
        total = int(self.ask(f"/v1/jobs/{job_id}/artifacts/sum.txt"))
        assert total == sum(range(job["options"]["steps"] + 1))

    def begun_twice(self, step: int) -> list[int]:
        """Where the attempts begin of a job that the releases do one after the other, the first to a step."""
        return [0, step] if self.previous.results == self.current.results else [0]


@pytest.fixture
def service(
    postgres: EmbeddedPostgres, previous: Release, current: Release, tmp_path: Path
) -> Iterator[Service]:
    with copied_database(postgres, "template0") as conninfo:
        bench = WorkerHarness(conninfo, tmp_path, stale_seconds=STALE_SECONDS)
        service = Service(bench, previous, current)
        try:
            service.migrate(previous)
            service.start_front_end(previous)
            yield service
        finally:
            service.stop_front_end()
            bench.close()


@pytest.mark.exhaustive
def test_front_end_is_upgraded_before_workers(service: Service) -> None:
    """Jobs are under way at both changes, and those of the new front end are run by the old worker."""
    bench = service.bench
    old = bench.worker(name="old", release=service.previous)
    under_way = service.submit_held(bench.folder / "first")
    service.migrate(service.current)
    service.start_front_end(service.current)
    by_new_front_end = service.submit(steps=3)
    (bench.folder / "first").touch()
    service.check_succeeded(under_way, "old", [0])
    service.check_succeeded(by_new_front_end, "old", [0])

    under_way = service.submit_held(bench.folder / "second")
    service.replace_worker("new", old)
    bench.wait(under_way, lambda job: job.worker == "new")
    (bench.folder / "second").touch()
    service.check_succeeded(under_way, "new", service.begun_twice(35))


@pytest.mark.exhaustive
def test_workers_are_upgraded_before_front_end(service: Service) -> None:
    """Jobs are under way at both changes, and those of the old front end are run by the new worker."""
    bench = service.bench
    old = bench.worker(name="old", release=service.previous)
    under_way = service.submit_held(bench.folder / "first")
    service.migrate(service.current)
    service.replace_worker("new", old)
    bench.wait(under_way, lambda job: job.worker == "new")
    by_old_front_end = service.submit(steps=3)
    (bench.folder / "first").touch()
    service.check_succeeded(under_way, "new", service.begun_twice(35))
    service.check_succeeded(by_old_front_end, "new", [0])

    under_way = service.submit_held(bench.folder / "second")
    service.start_front_end(service.current)
    (bench.folder / "second").touch()
    service.check_succeeded(under_way, "new", [0])


@pytest.mark.exhaustive
def test_releases_go_on_with_jobs_of_each_other(service: Service) -> None:
    """Workers of both are killed; each goes on with what the other began if their results are the same."""
    bench = service.bench
    gates = [bench.folder / f"gate-{number}" for number in range(3)]
    old = bench.worker(name="old", release=service.previous)
    begun = service.submit_held(gates[0])
    bench.worker(name="old-too", release=service.previous)
    stays = service.submit_held(gates[1])
    service.migrate(service.current)

    new = bench.worker(name="new", release=service.current)
    bench.wait_until_up("new")
    old.kill()
    # Only the other old worker is free for what the killed one had begun.
    handed_back = service.submit_held(gates[2])
    assert bench.job(handed_back).worker == "new"
    gates[1].touch()
    service.check_succeeded(stays, "old-too", [0])
    bench.wait(begun, lambda job: job.worker == "old-too")
    gates[0].touch()
    service.check_succeeded(begun, "old-too", [0, 30])

    new.kill()
    bench.wait(handed_back, lambda job: job.worker == "old-too")
    gates[2].touch()
    service.check_succeeded(handed_back, "old-too", service.begun_twice(30))
    assert ("begins anew" in bench.log(handed_back)) != (len(service.begun_twice(30)) == 2)


@pytest.mark.exhaustive
async def test_previous_release_takes_jobs_of_current_front_end(
    postgres: EmbeddedPostgres, previous: Release, tmp_path: Path
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
                    "options": {"preset": "fast", "train": {"iterations": 50}},
                }
                job = (await http.post("/v1/jobs", json=body)).json()
                await asyncio.to_thread(bench.worker, name="old", release=previous)
                async with asyncio.timeout(MAX_WAIT_SECONDS):
                    while (now := (await http.get(f"/v1/jobs/{job['id']}")).json())["attempt"] == 0:
                        await asyncio.sleep(0.1)
                assert now["worker"] == "old" and now["options"]["train"]["iterations"] == 50
        finally:
            await asyncio.to_thread(bench.close)
