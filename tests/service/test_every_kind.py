"""Each kind of job, run once by a worker with all that keeps jobs apart from it."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from test_scene_jobs import CUBE, CUBE_FACES, Jobs
from test_stage_jobs import HDR

from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.workers.worker.job_kinds import job_kinds
from tests.support.service_harness import running_service
from tests.support.small_run import RUN_OPTIONS
from tests.support.worker_harness import ROOT

SMALL: dict[str, Any] = {"mode": "turntable", "frames": 2, "width_px": 32, "height_px": 24}
STAGE = "[[lights]]\nkind = 'point'\nposition = [0, 0, 0]\nintensity = 1.0\n\n[integrator]\nsamples = 1\n"


@pytest.fixture
def worker(conninfo: str, tmp_path: Path) -> Iterator[None]:
    environment = {
        **os.environ,
        "DATABASE_URL": conninfo,
        "OCTASPLAT_STORAGE": str(tmp_path / "store"),
        "OCTASPLAT_WORK": str(tmp_path / "work"),
        "OCTASPLAT_FLOOR_BYTES": "0",
        "OCTASPLAT_POLL_SECONDS": "0.2",
        "OMP_NUM_THREADS": "1",
    }
    command = [sys.executable, "-m", "octasplat", "worker", "--queues", "cpu"]
    with subprocess.Popen(command, cwd=ROOT, env=environment) as process:
        yield
        process.terminate()


async def photographs(http: httpx.AsyncClient, folder: Path) -> str:
    """A dataset of a few small photographs with poses."""
    write_synthetic_dataset(
        folder, SyntheticDatasetConfig(views=8, width_px=48, height_px=36, samples_per_side=1, points=500)
    )
    dataset = (await http.post("/v1/datasets", json={"name": "small"})).json()["id"]
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.parts[len(folder.parts)] in ("images", "sparse"):
            name = path.relative_to(folder).as_posix()
            answer = await http.put(f"/v1/datasets/{dataset}/files/{name}", content=path.read_bytes())
            assert answer.status_code == 201, answer.text
    committed = await http.post(f"/v1/datasets/{dataset}/commit", timeout=120)
    assert committed.json()["state"] == "committed", committed.text
    return str(dataset)


def cube(height: float) -> bytes:
    """A mesh around the scene."""
    lines = [f"v {x} {y} {z + height}" for x, y, z in CUBE]
    return "\n".join([*lines, *(f"f {a + 1} {b + 1} {c + 1}" for a, b, c in CUBE_FACES), ""]).encode()


@pytest.mark.heavy
async def test_every_kind_of_job_succeeds_in_its_own_process(
    conninfo: str, tmp_path: Path, worker: None
) -> None:
    done: set[str] = set()
    async with running_service(conninfo, tmp_path, kind_modules=()) as (http, _service):
        jobs = Jobs(http)
        dataset = await photographs(http, tmp_path / "scene")

        async def run(kind: str, options: dict[str, Any], source: str | None, **files: bytes) -> str:
            done.add(kind)
            return await jobs.make(kind, options, source, **files)

        done.add("reconstruct")
        body = {"kind": "reconstruct", "dataset_id": dataset, "options": {**RUN_OPTIONS, "materials": True}}
        whole = await jobs.finish((await http.post("/v1/jobs", json=body)).json())
        assert {"scene.ply", "environment.hdr"} <= await jobs.names(whole)

        assert "metrics.json" in await jobs.names(await run("evaluate", {}, whole))
        files = ["a.glb", "a.spz", "a.splat", "a.obj"]
        assert {"a.glb", "a.spz"} <= await jobs.names(await run("export", {"files": files}, whole))
        assert "turntable.mp4" in await jobs.names(await run("render", {**SMALL, "format": "mp4"}, whole))
        staged = {**SMALL, "format": "png", "stage": STAGE}
        assert len(await jobs.names(await run("render", staged, whole))) == 2
        lit = {**SMALL, "format": "png", "environments": ["sky.hdr"], "samples": 1}
        assert len(await jobs.names(await run("relight", lit, whole, sky__hdr=HDR))) == 2
        assert await jobs.names(await run("stage-init", {}, whole)) == {"stage.toml"}
        changed = await run("material", {"set": {"roughness": 0.4}}, whole)
        assert "edits.json" in await jobs.names(changed)
        facts = await jobs.names(await run("info", {}, whole))
        assert "picture.png" in facts
        surface = {"depth_side": 64, "texture_size": 64, "max_triangles": ["400"], "fit": False}
        assert "surface.glb" in await jobs.names(await run("surface", surface, whole))
        await run("crop", {"where": "x > -100"}, whole)
        await run("clean", {"min_opacity": 0.01}, whole)
        await run("simplify", {"count": 20}, whole)
        await run("transform", {"scale": 2}, whole)
        mesh = await jobs.read(whole, "mesh.ply")
        await run("edit", {"meshes": ["m.ply"]}, whole, m__ply=mesh)
        moved = {"proxy": "c.obj", "deformed": ["d.obj"], "reach": "inf"}
        await run("deform", moved, whole, c__obj=cube(0), d__obj=cube(1))
        scene = await jobs.read(whole, "scene.ply")
        await run("merge", {"scenes": ["other.ply"]}, whole, other__ply=scene)
        await run("import", {"file": "a.ply"}, None, a__ply=scene)
        log = (await http.get(f"/v1/jobs/{whole}/logs")).json()
        assert "PermissionError" not in json.dumps(log)
    # Other tests of the same process register kinds of their own.
    assert done == {kind.name for kind in job_kinds() if kind.program.startswith("octasplat.")}
