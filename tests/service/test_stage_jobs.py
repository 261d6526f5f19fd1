"""Stages as jobs: what is wrong with one is a problem document, and a sound one gives the command's bytes."""

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from click.testing import CliRunner
from test_reconstruction import ROOT

from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.files.gaussian_ply import read_gaussian_ply
from octasplat.engine.operations.reconstruct import options_from_json
from octasplat.engine.pipeline import reconstruct
from octasplat.engine.render.image_files import write_png
from octasplat.service.state import Service
from octasplat.workers.cli.main import cli
from octasplat.workers.db.locks import lock_owner
from octasplat.workers.queue.job_results import ResultFile
from tests.support.bad_stages import BAD_STAGES, VALIDATORS_WORDS
from tests.support.service_harness import (
    ConnectService,
    claim_job,
    committed_dataset,
    running_service,
    store_content,
)

TRIANGLE = b"v 0 0 0\nv .3 0 0\nv 0 -.3 0\nf 1 2 3\n"
GLB = b"glTF\2\0\0\0\x30\0\0\0\x1c\0\0\0JSON" + b'{"asset":{"version":"2.0"}} '
HDR = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 2\n" + bytes([128, 128, 128, 128] * 4)


async def finished(http: httpx.AsyncClient, service: Service, files: dict[str, bytes]) -> str:
    """A reconstruction that ended with these results."""
    dataset = await committed_dataset(service)
    facts = json.dumps({"width_px": 48, "height_px": 36})
    async with service.pool.connection() as connection:
        await lock_owner(connection, "local")
        for number in range(8):
            await connection.execute(
                "INSERT INTO dataset_files (dataset_id, path, sha256, size_bytes, facts) "
                "VALUES (%s, %s, %s, 1, %s)",
                [dataset, f"images/{number}.png", store_content(service, b"x"), facts],
            )
    job = (await http.post("/v1/jobs", json={"dataset_id": dataset})).json()
    attempt = await claim_job(service, job)
    await attempt.succeed(
        [
            ResultFile(name, store_content(service, content), len(content), "x/y")
            for name, content in files.items()
        ],
        20.0,
    )
    return str(job["id"])


async def sent(http: httpx.AsyncClient, files: dict[str, bytes]) -> str:
    """A committed dataset of files that options name."""
    dataset = (await http.post("/v1/datasets", json={"name": "things", "holds": "files"})).json()["id"]
    for name, content in files.items():
        answer = await http.put(f"/v1/datasets/{dataset}/files/{name}", content=content)
        assert answer.status_code == 201, answer.text
    committed = (await http.post(f"/v1/datasets/{dataset}/commit")).json()
    assert committed["state"] == "committed" and committed["facts"]["files"] == len(files)
    return str(dataset)


BAD = [
    ("color = 1", "options", "#/options/stage/color", "no key stage.color"),
    ("[[meshes]", "options", "#/options/stage", "no TOML"),
    (
        "[[meshes]]\nshape = 'cube'\nposition = [nan, 0, 0]",
        "options", "#/options/stage/meshes/0/position/0", "finite",
    ),
    ("[[meshes]]\nfile = 'chair.glb'", "file-missing", "#/options/stage/meshes/0/file", "'chair.glb'"),
    (
        "[[meshes]]\nshape = 'cube'\nmaterial = { kind = 'glass', ior = 9 }",
        "options", "#/options/stage/meshes/0/material/ior", "stage.meshes[0].material.ior",
    ),
    ("[environment]\nfile = 'sky.hdr'", "file-missing", "#/options/stage/environment/file", "'sky.hdr'"),
    ("[[meshes]]\nfile = '../thing.obj'", "file-missing", "#/options/stage/meshes/0/file", "'../thing.obj'"),
    ("[[meshes]]\nfile = '/etc/a.obj'", "file-missing", "#/options/stage/meshes/0/file", "'/etc/a.obj'"),
    (
        "[[meshes]]\nfile = 'thing.obj'\nmaterial = { kind = 'diffuse', texture = 'wood.png' }",
        "file-missing", "#/options/stage/meshes/0/material/texture", "'wood.png'",
    ),
    (
        "[[meshes]]\nshape = 'cube'\nscale = [1, 2]",
        "options", "#/options/stage/meshes/0/scale", "one positive number, or three",
    ),
    ("[integrator]\nlayers = true", "options", "#/options/", "choose the format exr"),
    ("[integrator]\nsamples = 65536", "ceiling", "#/options/stage/integrator/samples", "paths of light"),
    (
        "[[lights]]\nkind='point'\nposition=[0,0,0]\nintensity=1\n" * 1001,
        "options", "#/options/stage/lights", "at most 1000",
    ),
    (
        "[[gaussians]]\nlight='relit'\n"
        "[[lights]]\nkind='point'\nposition=[0,0,0]\nintensity=1\nonly_shadows=true",
        "options", "#/options/stage/lights", "stage.lights: the shadows of lights[0]",
    ),
]  # fmt: skip


async def test_invalid_stage_problem_names_key(connect_service: ConnectService) -> None:
    async with connect_service(max_render_paths=10**9) as (http, service):
        source = await finished(http, service, {"scene.ply": b"ply"})
        files = await sent(http, {"thing.obj": TRIANGLE})
        body: dict[str, Any] = {"kind": "render", "source_id": source, "files_id": files}
        for stage, kind, pointer, words in BAD:
            refused = await http.post("/v1/jobs", json={**body, "options": {"stage": stage}})
            problem = refused.json()
            assert (refused.status_code, problem["type"]) == (422, f"urn:octasplat:problem:{kind}"), problem
            assert refused.headers["content-type"] == "application/problem+json"
            [fault] = problem["errors"]
            assert fault["pointer"] == pointer and words in fault["detail"], fault
        for stage in BAD_STAGES:
            refused = await http.post("/v1/jobs", json={**body, "options": {"stage": stage}})
            assert refused.status_code == 422, (stage, refused.text)
            assert not VALIDATORS_WORDS.search(refused.text), refused.text
            for fault in refused.json()["errors"]:
                assert (
                    fault["pointer"].startswith("#/options/stage") and "constrained" not in fault["pointer"]
                )
        # As JSON, where there is no NaN, but Python's reader takes it.
        text = json.dumps(
            {**body, "options": {"stage": {"meshes": [{"shape": "cube", "scale": float("nan")}]}}}
        )
        refused = await http.post("/v1/jobs", content=text, headers={"Content-Type": "application/json"})
        assert refused.status_code == 422 and refused.json()["type"].endswith(("options", "request"))
        million = "[[lights]]\nkind='point'\nposition=[0,0,0]\nintensity=1\n" * 1_000_000
        too_long = await http.post("/v1/jobs", json={**body, "options": {"stage": million}})
        assert (too_long.status_code, too_long.json()["type"]) == (413, "urn:octasplat:problem:too-large")
        assert (await http.get("/v1/jobs", params={"kind": "render"})).json()["jobs"] == []


async def test_preview_counts_as_one_image(connect_service: ConnectService) -> None:
    one_image = 48 * 36
    async with connect_service(max_render_pixels=one_image) as (http, service):
        source = await finished(http, service, {"scene.ply": b"ply"})
        options = {"mode": "views", "views": "all", "format": "png", "stage": "[[meshes]]\nshape = 'cube'"}
        body = {"kind": "render", "source_id": source}
        whole = await http.post("/v1/jobs", json={**body, "options": options})
        assert (whole.status_code, whole.json()["type"]) == (422, "urn:octasplat:problem:ceiling")
        preview = await http.post("/v1/jobs", json={**body, "options": {**options, "preview": True}})
        assert preview.status_code == 202, preview.text


async def test_stage_files_are_checked_on_upload(connect_service: ConnectService) -> None:
    async with connect_service() as (http, service):
        dataset = (await http.post("/v1/datasets", json={"holds": "files"})).json()["id"]
        address = f"/v1/datasets/{dataset}/files/"
        for name, content, kind in [
            ("sky.hdr", b"no picture", "image-kind"),
            ("sky.hdr", HDR[:-10], "image-cut-off"),
            ("thing.glb", TRIANGLE, "file-kind"),
            ("thing.glb", b"glTF", "file-kind"),
            ("thing.glb", GLB[:-1], "file-kind"),
            ("thing.obj", b"\0\1\2", "file-kind"),
            ("thing.obj", b"v 0 0 0\n# " + b"x" * 70_000 + b"\n", "file-kind"),
            ("..%2Fthing.obj", TRIANGLE, "name-traversal"),
            ("thing.exe", b"MZ", "name-unexpected"),
        ]:
            refused = await http.put(address + name, content=content)
            assert (refused.status_code, refused.json()["type"]) == (422, f"urn:octasplat:problem:{kind}"), (
                name
            )
        archive = await http.put(f"/v1/datasets/{dataset}/archive", content=b"PK")
        assert archive.status_code == 409
        empty = await http.post(f"/v1/datasets/{dataset}/commit")
        assert (empty.status_code, empty.json()["type"]) == (422, "urn:octasplat:problem:dataset-files")
        for name, content in (("thing.obj", TRIANGLE), ("sky.hdr", HDR), ("thing.glb", GLB)):
            assert (await http.put(address + name, content=content)).status_code == 201
        source = await finished(http, service, {"scene.ply": b"ply"})
        body = {"kind": "render", "source_id": source, "options": {"stage": "[[meshes]]\nfile = 'thing.obj'"}}
        early = await http.post("/v1/jobs", json={**body, "files_id": dataset})
        assert (early.status_code, early.json()["type"]) == (409, "urn:octasplat:problem:dataset-open")
        assert (await http.post(f"/v1/datasets/{dataset}/commit")).json()["state"] == "committed"
        photographs = (await http.get(f"/v1/jobs/{source}")).json()["dataset_id"]
        for files_id in (photographs, str(uuid.uuid4())):
            refused = await http.post("/v1/jobs", json={**body, "files_id": files_id})
            assert refused.status_code == 422 and refused.json()["errors"][0]["pointer"] == "#/files_id"
        refused = await http.post("/v1/jobs", json={"dataset_id": dataset})
        assert refused.status_code == 422 and refused.json()["errors"][0]["pointer"] == "#/dataset_id"
        made = await http.post("/v1/jobs", json={**body, "files_id": dataset})
        assert made.status_code == 202 and made.json()["files_id"] == dataset
        # More paths take more time, and as long as the job is there its files stay.
        plain = await http.post("/v1/jobs", json={"kind": "render", "source_id": source})
        assert made.json()["estimate"]["cpu_seconds"] > 2 * plain.json()["estimate"]["cpu_seconds"]
        assert (await http.delete(f"/v1/datasets/{dataset}")).status_code == 409


STAGE = """
[[meshes]]
file = "../things/thing.obj"
on = { view = "%s", pixel = [24, 20] }
scale = 2
material = { kind = "metal", roughness = 0.3 }
[environment]
file = "sky.hdr"
visible = false
[integrator]
samples = 8
"""
FRAMES = {"frames": 6, "width_px": 32, "height_px": 24}


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of a moment, and a stage beside it."""
    root = tmp_path_factory.mktemp("staged")
    config = SyntheticDatasetConfig(views=8, width_px=48, height_px=36, samples_per_side=1, points=500)
    write_synthetic_dataset(root / "scene", config)
    train = {
        "iterations": 20,
        "rays_per_batch": 512,
        "max_gaussians": 500,
        "initial_points": 400,
        "densify_from_iter": 0,
    }
    asked = options_from_json({"preset": "fast", "train": train, "exports": ["mesh.ply"]})
    reconstruct(root / "scene", root / "run", asked.config(), threads=1)
    (root / "things").mkdir()
    (root / "things" / "t").mkdir()
    (root / "things" / "thing.obj").write_bytes(b"mtllib a.mtl\n" + TRIANGLE)
    (root / "things" / "a.mtl").write_bytes(b"newmtl a\nKd 1 0 0\nmap_Kd t\\a.png\n")
    write_png(root / "things" / "t" / "a.png", np.ones((2, 2, 3), np.float32))
    (root / "stages").mkdir()
    (root / "stages" / "sky.hdr").write_bytes(HDR)
    view = json.loads((root / "run" / "held_out.json").read_text())[0]
    (root / "stages" / "stage.toml").write_text(STAGE % view)
    assert len(read_gaussian_ply(root / "run" / "scene.ply")[0]) > 100
    return root


@pytest.mark.exhaustive
@pytest.mark.heavy
async def test_killed_render_job_resumes_to_command_bytes(conninfo: str, tmp_path: Path, run: Path) -> None:
    from octasplat.workers.client.submission import Derivation, with_stage

    stage = run / "stages" / "stage.toml"
    size = ("--frames", "6", "--width", "32", "--height", "24", "--threads", "1")
    command = ["render", run / "run", "-o", tmp_path / "film.mp4", "--turntable", "--stage", stage, *size]
    done = CliRunner().invoke(cli, [str(part) for part in command])
    assert done.exit_code == 0, done.output
    what = with_stage(Derivation("", "render", FRAMES), stage)
    # What lies elsewhere gets a name without "..", and brings what it mentions along.
    beside = {f"elsewhere/1/{name}" for name in ("thing.obj", "a.mtl", "t/a.png")}
    assert set(what.files) == {*beside, "sky.hdr"}
    workers: list[subprocess.Popen[bytes]] = []

    def worker(name: str) -> None:
        given = {
            "STORAGE": tmp_path / "store", "WORK": tmp_path / name, "FLOOR_BYTES": 0, "THREADS": 1,
            "HEARTBEAT_SECONDS": 0.4, "STALE_SECONDS": 12, "RESCUE_SECONDS": 0.3, "POLL_SECONDS": 0.15,
            "KIND_MODULES": '["tests.support.frequent_frames"]',
        }  # fmt: skip
        environment = {f"OCTASPLAT_{key}": str(value) for key, value in given.items()}
        workers.append(
            subprocess.Popen(
                [sys.executable, "-m", "octasplat", "worker", "--queues", "cpu", "--name", name],
                cwd=ROOT,
                env={
                    **os.environ, **environment, "DATABASE_URL": conninfo, "OMP_NUM_THREADS": "1",
                    "PYTHONPATH": str(ROOT),
                },
            )
        )  # fmt: skip

    try:
        async with running_service(conninfo, tmp_path, kind_modules=()) as (http, service):
            names = ("scene.ply", "config.json", "held_out.json", "views.json")
            source = await finished(
                http, service, {name: (run / "run" / name).read_bytes() for name in names}
            )
            files = await sent(http, {name: path.read_bytes() for name, path in what.files.items()})
            body = {"kind": "render", "source_id": source, "files_id": files, "options": dict(what.options)}
            made = await http.post("/v1/jobs", json=body)
            assert made.status_code == 202, made.text
            address = made.headers["Location"]

            async def until(wanted: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
                deadline = time.monotonic() + 200
                while time.monotonic() < deadline:
                    job: dict[str, Any] = (await http.get(address)).json()
                    if wanted(job):
                        return job
                    assert job["state"] != "failed", job
                    await asyncio.sleep(0.05)
                raise AssertionError(job)

            worker("first")
            job = await until(lambda job: job["checkpoint"] is not None or job["state"] == "succeeded")
            assert job["state"] == "running" and job["checkpoint"]["stage"] == "render"
            workers[0].send_signal(signal.SIGKILL)
            worker("second")
            job = await until(lambda job: job["state"] == "succeeded")
            assert job["worker"] == "second" and job["attempt"] == 2
            log = [line["text"] for line in (await http.get(f"{address}/logs")).json()["lines"]]
            assert any(line.startswith("Goes on from step ") and "of render" in line for line in log), log
            film = (await http.get(f"{address}/artifacts/turntable.mp4")).content
            assert film == (tmp_path / "film.mp4").read_bytes()
    finally:
        for process in workers:
            process.kill()
            process.wait(120)
