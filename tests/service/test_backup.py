"""A backup made while the service runs, restored elsewhere: everything is there and goes on."""

import asyncio
import json
import os
import subprocess
import sys
import time
import uuid
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import psycopg
import pytest
from psycopg.conninfo import make_conninfo

from octasplat.service.state import Service
from octasplat.workers.db.migrate import OWN_COMPONENT, all_migrations, migrate
from octasplat.workers.maintenance.backup import create_backup, restore_backup
from octasplat.workers.queue.job_results import ResultFile
from octasplat.workers.storage.local import LocalStorage
from tests.support.model_builder import photograph
from tests.support.postgres_fixtures import EmbeddedPostgres, copied_database
from tests.support.service_harness import (
    claim_job,
    client_with_token,
    committed_dataset,
    new_job,
    running_service,
    store_content,
    task_over,
)
from tests.support.worker_harness import WorkerHarness

ROOT = Path(__file__).parents[2]


def octasplat(conninfo: str, data: Path, *arguments: object) -> "subprocess.CompletedProcess[str]":
    environment = {
        **os.environ,
        "DATABASE_URL": conninfo,
        "OCTASPLAT_DATA": str(data),
        "OCTASPLAT_STORAGE": str(data / "store"),
        "OCTASPLAT_FLOOR_BYTES": "0",
    }
    command = [sys.executable, "-m", "octasplat", *map(str, arguments)]
    return subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, check=False)


def finish_jobs(bench: WorkerHarness, jobs: list[str]) -> None:
    """Let a worker do the jobs of a restored service."""
    try:
        bench.worker(STALE_SECONDS="10")
        for job in jobs:
            row = bench.wait_until_finished(uuid.UUID(job))
            assert (row.state, row.rescues) == ("succeeded", 0)
            assert bench.results(row.id)["sum.txt"] == b"6"
    finally:
        bench.close()


@pytest.mark.exhaustive
async def test_restored_service_continues_jobs(
    conninfo: str, postgres: EmbeddedPostgres, template: str, tmp_path: Path
) -> None:
    backup, here, there = tmp_path / "backup", tmp_path / "here", tmp_path / "there"
    made: dict[str, Any] = {}

    async def before(http: httpx.AsyncClient, service: Service) -> None:
        made["headers"] = await client_with_token(service, "me", "write")
        http.headers.update(made["headers"])
        made["dataset"] = (await http.post("/v1/datasets", json={"name": "d"})).headers["Location"]
        address = f"{made['dataset']}/files/images/a.png"
        assert (await http.put(address, content=photograph())).status_code == 201
        scene = await committed_dataset(service, "me")
        body = {"dataset_id": scene, "kind": "toy", "options": {"steps": 3, "seconds": 0.0}}
        done, under_way, queued = [(await http.post("/v1/jobs", json=body)).json() for _ in range(3)]
        attempt = await claim_job(service, done)
        result = ResultFile("a.txt", store_content(service, b"a result"), 8, "text/plain")
        await attempt.succeed([result])
        await claim_job(service, under_way)
        made["jobs"] = [job["id"] for job in (done, under_way, queued)]
        for again in range(2):
            saved = await asyncio.to_thread(octasplat, conninfo, here, "backup", backup)
            assert saved.returncode == 0, saved.stderr
            store_content(service, f"named by nothing {again}".encode())
        # What happens afterwards is not in it.
        assert (await http.delete(made["dataset"])).status_code == 204
        made["usage"] = (len(list((backup / "store").rglob("*"))), len(list(backup.glob("tables-*"))))

    async def after(http: httpx.AsyncClient, service: Service) -> None:
        http.headers.pop("Authorization", None)
        assert (await http.get("/v1/jobs")).status_code == 401
        http.headers.update(made["headers"])
        answer = await http.get(f"{made['dataset']}/files/images/a.png")
        assert answer.content == photograph()
        done, *others = made["jobs"]
        assert (await http.get(f"/v1/jobs/{done}/artifacts/a.txt")).content == b"a result"
        assert [(await http.get(f"/v1/jobs/{job}")).json()["state"] for job in others] == ["queued"] * 2
        body = {"dataset_id": (await http.get(f"/v1/jobs/{done}")).json()["dataset_id"], "kind": "toy"}
        new = (await http.post("/v1/jobs", json={**body, "options": {"steps": 3, "seconds": 0.0}})).json()
        made["jobs"].append(new["id"])

    async with running_service(conninfo, here) as (http, service):
        await before(http, service)
    assert made["usage"][1] == 1
    with copied_database(postgres, "template1") as elsewhere:
        restored = octasplat(elsewhere, there, "restore", backup)
        assert restored.returncode == 0, restored.stderr
        again = octasplat(elsewhere, there, "restore", backup)
        assert again.returncode == 1 and "not empty" in again.stderr and again.stderr.count("\n") == 1
        assert octasplat(elsewhere, there, "fsck").returncode == 0
        async with running_service(elsewhere, there) as (http, service):
            await after(http, service)
        await asyncio.to_thread(finish_jobs, WorkerHarness(elsewhere, there), made["jobs"][1:])


@pytest.mark.exhaustive
async def test_upload_goes_on_where_it_is_restored(
    conninfo: str, postgres: EmbeddedPostgres, template: str, tmp_path: Path
) -> None:
    backup, here, there = tmp_path / "backup", tmp_path / "here", tmp_path / "there"
    content = photograph()
    headers = {"Upload-Length": str(len(content)), "Upload-Metadata": "path aW1hZ2VzL2EucG5n"}
    part = {"Content-Type": "application/offset+octet-stream"}
    async with running_service(conninfo, here) as (http, _):
        dataset = (await http.post("/v1/datasets", json={"name": "d"})).headers["Location"]
        upload = (await http.post(f"{dataset}/uploads", headers=headers)).headers["Location"]
        sent = await http.patch(upload, content=content[:20], headers={**part, "Upload-Offset": "0"})
        assert sent.status_code == 204
        saved = await asyncio.to_thread(octasplat, conninfo, here, "backup", backup)
        assert saved.returncode == 0, saved.stderr
    with copied_database(postgres, "template1") as elsewhere:
        restored = octasplat(elsewhere, there, "restore", backup)
        assert restored.returncode == 0, restored.stderr
        async with running_service(elsewhere, there, has_token=False) as (http, _):
            rest = await http.patch(upload, content=content[20:], headers={**part, "Upload-Offset": "20"})
            assert rest.status_code == 204, rest.text
            answer = httpx.Response(202, headers={"Location": rest.headers["Location"]})
            assert (await task_over(http, answer))["state"] == "succeeded"
            assert (await http.get(f"{dataset}/files/images/a.png")).content == content


def test_backup_of_an_earlier_version_is_restored(postgres: EmbeddedPostgres, tmp_path: Path) -> None:
    backup, steps = tmp_path / "backup", [
        step.name for step in all_migrations() if step.component == OWN_COMPONENT and step.name < "0016"
    ]  # fmt: skip
    owner, content = "me", b"a photograph"
    store = LocalStorage(tmp_path / "here", floor_bytes=0)
    with store.open_writer() as writer:
        writer.write(content)
        blob = writer.commit()
    with copied_database(postgres, "template1") as before:
        migrate(before, only=steps)
        with psycopg.connect(before) as connection:
            made = connection.execute(
                "INSERT INTO datasets (id, owner, name) VALUES (gen_random_uuid(), %s, 'd') RETURNING id",
                [owner],
            ).fetchone()
            assert made is not None
            connection.execute(
                "INSERT INTO dataset_files (dataset_id, path, sha256, size_bytes, facts) "
                "VALUES (%s, 'images/a.png', %s, %s, '{}')",
                [made[0], blob.sha256, blob.size_bytes],
            )
        assert create_backup(before, store, backup).contents == 1
    with copied_database(postgres, "template1") as elsewhere:
        there = LocalStorage(tmp_path / "there", floor_bytes=0)
        assert restore_backup(elsewhere, there, backup).contents == 1
        with psycopg.connect(elsewhere) as connection:
            assert connection.execute("SELECT bytes FROM owner_usage WHERE bytes > 0").fetchall() == [(12,)]
        with there.open(blob.sha256) as file:
            assert file.read() == content


def test_backup_beside_a_migration_is_repeated_after_a_deadlock(conninfo: str, tmp_path: Path) -> None:
    waiting_backup = "SELECT FROM pg_locks WHERE relation = 'artifacts'::regclass AND NOT granted"
    # The side whose time is over first finds the deadlock and is the one that fails. It looks once, so the
    # backup's time has to last until the other side waits, too.
    patient = make_conninfo(conninfo, options="-c deadlock_timeout=5s")
    with ThreadPoolExecutor() as threads, psycopg.connect(conninfo) as changing:
        changing.execute("SET deadlock_timeout = '120s'")
        changing.execute("ALTER TABLE artifacts ADD COLUMN later_a text NOT NULL DEFAULT 'a'")
        made = threads.submit(
            create_backup, patient, LocalStorage(tmp_path / "store", floor_bytes=0), tmp_path / "backup"
        )
        while changing.execute(waiting_backup).fetchone() is None:
            assert not made.done(), made.result()
            time.sleep(0.01)
        changing.execute("ALTER TABLE datasets ADD COLUMN later_d text NOT NULL DEFAULT 'd'")
        changing.commit()
        made.result()
    tables = json.loads((tmp_path / "backup" / "backup.json").read_text())["tables"]
    columns = {table["name"]: table["columns"] for table in tables}
    assert columns["artifacts"][-1] == "later_a" and columns["datasets"][-1] == "later_d"


@pytest.mark.parametrize("folder", ["nothing", "other"])
def test_restore_of_invalid_folder_is_refused(conninfo: str, tmp_path: Path, folder: str) -> None:
    (tmp_path / "nothing").mkdir()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "a.txt").write_text("mine")
    answer = octasplat(conninfo, tmp_path / "data", "restore", tmp_path / folder)
    assert answer.returncode == 1 and "holds no backup" in answer.stderr and answer.stderr.count("\n") == 1
    if folder == "other":
        answer = octasplat(conninfo, tmp_path / "data", "backup", tmp_path / folder)
        assert answer.returncode == 1 and "no backup" in answer.stderr
        assert [path.name for path in (tmp_path / "other").iterdir()] == ["a.txt"]


async def test_restored_jobs_that_were_stopping_have_ended(
    conninfo: str, postgres: EmbeddedPostgres, template: str, tmp_path: Path
) -> None:
    backup, here, there = tmp_path / "backup", tmp_path / "here", tmp_path / "there"
    async with running_service(conninfo, here) as (http, service):
        job = await new_job(http, service)
        await claim_job(service, job)
        stopping = await http.post(f"/v1/jobs/{job['id']}/cancel")
        assert stopping.json()["state"] == "canceling"
        create_backup(conninfo, LocalStorage(here / "store", floor_bytes=0), backup)
    with copied_database(postgres, "template1") as elsewhere:
        restore_backup(elsewhere, LocalStorage(there / "store", floor_bytes=0), backup)
        async with running_service(elsewhere, there, has_token=False) as (http, _):
            restored = (await http.get(f"/v1/jobs/{job['id']}")).json()
            assert restored["state"] == "canceled" and restored["finished_at"] is not None
