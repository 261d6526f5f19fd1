"""What cannot be written is refused when it is asked for, and costs nothing of what can."""

import json
import os
import subprocess
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from test_reconstruction import ROOT, TRAIN, Machine, start

from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.files import exporters
from octasplat.service.state import Service
from octasplat.workers.client.submission import Submission, submit
from octasplat.workers.client.watch import watch_job
from octasplat.workers.db.workers import record_worker_heartbeat
from octasplat.workers.queue.job_results import ResultFile
from tests.support.service_harness import ConnectService, claim_job, committed_dataset

FORMATS = [exporter.name for exporter in exporters()]


async def worker_lives(service: Service, *lacking: str, queue: str = "cpu") -> None:
    facts = {"formats": [name for name in FORMATS if name not in lacking]}
    async with service.pool.connection() as connection:
        await record_worker_heartbeat(
            connection, uuid.uuid4(), name="w", queues=[queue], slots=1, facts=facts
        )


async def test_queued_job_says_why_no_worker_takes_it(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        dataset = await committed_dataset(service)
        made = await http.post("/v1/jobs", json={"dataset_id": dataset})

        async def heartbeat(worker: uuid.UUID, ailing: str | None) -> list[str]:
            async with service.pool.connection() as connection:
                await record_worker_heartbeat(
                    connection, worker, name="w", queues=["cpu"], slots=1, facts={"ailing": ailing}
                )
            notes: list[str] = (await http.get(made.headers["Location"])).json()["notes"]
            return notes

        first, second = uuid.uuid4(), uuid.uuid4()
        told = await heartbeat(first, "the folder /srv/data/octasplat/work cannot be written")
        reason = "the folder …/octasplat/work cannot be written"
        assert told == [f"The workers of the queue cpu take no jobs for now: {reason}."]
        assert await heartbeat(second, None) == []  # this one takes it
        assert await heartbeat(first, None) == []


async def test_create_job_unwritable_format_is_refused(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        dataset = await committed_dataset(service)
        body = {"dataset_id": dataset, "options": {"exports": ["mesh.glb", "scene.sog"]}}
        early = await http.post("/v1/jobs", json=body)  # nobody is there who could say
        assert early.status_code == 202
        first, second = early.json()["notes"]
        assert "No worker takes jobs from the queue cpu" in first and "scene.sog" in second
        await worker_lives(service, "sog", "usd")
        now = (await http.get(early.headers["Location"])).json()
        assert now["notes"] == []
        refused = await http.post("/v1/jobs", json=body)
        assert (refused.status_code, refused.json()["type"]) == (422, "urn:octasplat:problem:unwritable")
        [fault] = refused.json()["errors"]
        assert fault["pointer"] == "#/options/exports/1" and "scene.sog" in fault["detail"]
        assert "splat-transform" in fault["detail"]
        page = (await http.get("/new")).text
        boxes = {
            line.split('value="')[1].split('"')[0]: line for line in page.splitlines() if "checkbox" in line
        }
        assert "disabled" in boxes["scene.sog"] and "disabled" in boxes["scene.usdz"]
        assert "disabled" not in boxes["viewer.glb"] and "checked" in boxes["viewer.glb"]
        await worker_lives(service, "usd")  # another one that can
        assert (await http.post("/v1/jobs", json=body)).status_code == 202
        elsewhere = {**body, "queue": "large", "options": {"exports": ["scene.usdz"]}}
        assert (await http.post("/v1/jobs", json=elsewhere)).status_code == 202  # nobody is there


async def test_retry_with_other_options(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        await worker_lives(service, "sog")
        body = {"dataset_id": await committed_dataset(service), "options": {"preset": "fast"}}
        job = (await http.post("/v1/jobs", json=body)).json()
        address = f"/v1/jobs/{job['id']}"
        attempt = await claim_job(service, job)
        manifest = {"attempt": 1, "stage": "train", "step": 9, "files": []}
        await attempt.record_checkpoint(manifest, is_progress=True)
        some = [ResultFile("scene.ply", "a" * 64, 1, "x/y"), ResultFile("config.json", "b" * 64, 1, "x/y")]
        await attempt.fail({"type": "export_failed", "message": "mesh.obj: no."}, some)
        failed = (await http.get(address)).json()
        assert failed["state"] == "failed" and failed["checkpoint"] == {"stage": "train", "step": 9}
        names = [a["name"] for a in (await http.get(f"{address}/artifacts")).json()["artifacts"]]
        assert names == ["config.json", "scene.ply"]
        export = {"kind": "export", "source_id": job["id"], "options": {"files": ["a.glb"]}}
        assert (await http.post("/v1/jobs", json=export)).status_code == 202  # there is a scene

        async def refused(options: dict[str, Any], code: str, pointer: str) -> None:
            answer = await http.post(f"{address}/retry", json={"options": options})
            assert (answer.status_code, answer.json()["type"]) == (422, f"urn:octasplat:problem:{code}")
            assert answer.json()["errors"][0]["pointer"] == pointer

        await refused({"exports": ["a.sog"]}, "unwritable", "#/options/exports/0")
        await refused({"exports": ["a.docx"]}, "options", "#/options/exports/0")
        await refused({"speed": 5}, "options", "#/options/speed")
        await refused({"train": {"iterations": 5}}, "other-work", "#/options")
        again = await http.post(f"{address}/retry", json={"options": {"exports": ["b.splat"]}})
        now = again.json()
        assert again.status_code == 202 and now["state"] == "queued"
        assert now["options"] == {**job["options"], "exports": ["b.splat"]}
        assert now["checkpoint"] == {"stage": "train", "step": 9}
        await http.post(f"{address}/cancel")
        anew = {"from": "start", "options": {"train": {"iterations": 5}}}
        now = (await http.post(f"{address}/retry", json=anew)).json()
        assert now["checkpoint"] is None and now["options"]["train"]["iterations"] == 5
        cap = job["options"]["train"]["max_gaussians_auto"]
        assert now["options"]["train"]["max_gaussians_auto"] == cap
        await http.post(f"{address}/cancel")
        other = {"from": "start", "options": {"preset": "standard"}}
        now = (await http.post(f"{address}/retry", json=other)).json()
        assert now["options"]["train"]["max_gaussians_auto"] == 400_000 != cap
        assert now["options"]["exports"] == ["b.splat"]


@pytest.fixture
def machine(short_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Machine]:
    """A service whose splat-transform is there and fails."""
    program = tmp_path / "splat-transform"
    program.write_text("#!/bin/sh\necho no WebGPU here >&2\nexit 3\n")
    program.chmod(0o755)
    monkeypatch.setenv("OCTASPLAT_SPLAT_TRANSFORM", str(program))
    machine = start(short_root / "partial")
    yield machine
    machine.stop()


@pytest.mark.exhaustive
@pytest.mark.heavy
def test_failed_export_keeps_other_results_and_retry_skips_training(machine: Machine, tmp_path: Path) -> None:
    config = SyntheticDatasetConfig(views=8, width_px=48, height_px=36, samples_per_side=1, points=500)
    write_synthetic_dataset(tmp_path / "scene", config)
    options = {
        "preset": "fast",
        "train": {**TRAIN, "iterations": 50},
        "exports": ["a.sog", "mesh.glb", "b.sog", "mesh.ply"],
    }
    with machine.api as api:
        job = submit(api, Submission(tmp_path / "scene", options))
        address = f"/v1/jobs/{job['id']}"
        done = watch_job(api, job["id"], lambda _event: None, lambda _state: None)
        assert done["state"] == "failed" and done["error"]["type"] == "export_failed"
        message = done["error"]["message"]
        assert message.startswith(
            "2 of 4 files could not be written: a.sog: splat-transform failed (no WebGPU"
        )
        assert "b.sog" in message and str(machine.data) not in message
        first = {a["name"]: a["sha256"] for a in api.get(f"{address}/artifacts")["artifacts"]}
        assert {"scene.ply", "metrics.json", "report.html", "mesh.glb", "mesh.ply"} <= set(first)
        assert "a.sog" not in first and any(name.startswith("renders/") for name in first)
        command = [sys.executable, "-m", "octasplat", "retry", job["id"], "--exports", "mesh.obj,mesh.glb"]
        environment = {**os.environ, "OCTASPLAT_DATA": str(machine.data)}
        said = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
        assert said.returncode == 0, said.stderr
        done = watch_job(api, job["id"], lambda _event: None, lambda _state: None)
        assert done["state"] == "succeeded" and done["attempt"] == 2, done
        second = {a["name"]: a["sha256"] for a in api.get(f"{address}/artifacts")["artifacts"]}
        assert second["scene.ply"] == first["scene.ply"] and second["mesh.glb"] == first["mesh.glb"]
        assert "mesh.obj" in second and "mesh.ply" not in second
        events = api.get(f"{address}/timeline", limit=5000)["events"]
        stages = [e["data"]["stage"] for e in events if e["kind"] == "stage_started" and e["attempt"] == 2]
        assert stages == ["load", "evaluate", "export"]
        assert json.loads(api.request("GET", f"{address}/artifacts/config.json").content)["reconstruction"][
            "exports"
        ] == ["mesh.obj", "mesh.glb"]
