"""Each kind of job, run once by a worker with all that keeps jobs apart: the files of the commands."""

import asyncio
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from click.testing import CliRunner
from test_stage_jobs import HDR, finished, run, sent  # noqa: F401 (a fixture)

from octasplat.engine.dataset.views_file import ViewsRecord
from octasplat.engine.files.gaussian_ply import read_gaussian_ply
from octasplat.workers.cli.main import cli
from octasplat.workers.postgres.embedded import EmbeddedPostgres
from octasplat.workers.worker.job_kinds import job_kinds
from tests.support.postgres_fixtures import copied_database
from tests.support.service_harness import running_service
from tests.support.small_run import RUN_OPTIONS
from tests.support.worker_harness import ROOT

pytestmark = pytest.mark.heavy

RUN_FILES = ("scene.ply", "config.json", "held_out.json", "views.json", "training.json")
CUBE = [(x, y, z) for x in (-9, 9) for y in (-9, 9) for z in (-9, 9)]
CUBE_FACES = [
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
]  # fmt: skip


SMALL: dict[str, Any] = {"mode": "turntable", "frames": 2, "width_px": 32, "height_px": 24}
STAGE = "[[lights]]\nkind = 'point'\nposition = [0, 0, 0]\nintensity = 1.0\n\n[integrator]\nsamples = 1\n"
SCENE_KINDS = {"crop", "transform", "edit", "deform", "merge", "clean", "simplify", "export", "import"}
"""Kinds that make scenes of scenes."""


@pytest.fixture(scope="module")
def database(postgres: EmbeddedPostgres, template: str) -> Iterator[str]:
    with copied_database(postgres, template) as copied:
        yield copied


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the service and its worker."""
    return tmp_path_factory.mktemp("kinds")


@pytest.fixture(scope="module")
def worker(database: str, data: Path) -> Iterator[None]:
    """A worker, as a program of its own."""
    given = {
        "STORAGE": data / "store", "WORK": data / "work", "FLOOR_BYTES": 0, "THREADS": 1, "POLL_SECONDS": 0.2,
    }  # fmt: skip
    environment = {f"OCTASPLAT_{key}": str(value) for key, value in given.items()}
    process = subprocess.Popen(
        [sys.executable, "-m", "octasplat", "worker", "--queues", "cpu"],
        cwd=ROOT, env={**os.environ, **environment, "DATABASE_URL": database, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    yield
    process.terminate()
    process.wait(120)


def octasplat(*arguments: object) -> None:
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output


async def photographs(http: httpx.AsyncClient, folder: Path) -> str:
    """A dataset of the photographs of a folder, with poses."""
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


class Jobs:
    """Asks for jobs, waits for them and reads their results."""

    def __init__(self, http: httpx.AsyncClient) -> None:
        self.http = http
        self.kinds: set[str] = set()

    async def make(self, kind: str, options: dict[str, Any], source: str | None, **files: bytes) -> str:
        self.kinds.add(kind)
        body: dict[str, Any] = {"kind": kind, "options": options}
        if source is not None:
            body["source_id"] = source
        if files:
            names = {name.replace("__", "."): content for name, content in files.items()}
            body["files_id"] = await sent(self.http, names)
        made = await self.http.post("/v1/jobs", json=body)
        assert made.status_code == 202, made.text
        return await self.finish(made.json())

    async def finish(self, job: dict[str, Any]) -> str:
        """The id of a job once it has succeeded."""
        deadline = time.monotonic() + 500
        while job["state"] in ("queued", "running"):
            assert time.monotonic() < deadline, job
            await asyncio.sleep(0.3)
            job = (await self.http.get(f"/v1/jobs/{job['id']}")).json()
        assert job["state"] == "succeeded", job
        return str(job["id"])

    async def names(self, job: str) -> set[str]:
        found = (await self.http.get(f"/v1/jobs/{job}/artifacts")).json()["artifacts"]
        return {artifact["name"] for artifact in found}

    async def read(self, job: str, name: str) -> bytes:
        answer = await self.http.get(f"/v1/jobs/{job}/artifacts/{name}")
        assert answer.status_code == 200, answer.text
        return answer.content


async def test_crop_job_gives_the_files_of_the_command(
    database: str,
    data: Path,
    tmp_path: Path,
    run: Path,  # noqa: F811
    worker: None,
) -> None:
    source = run / "run"
    octasplat("crop", source, "--where", "x > 0", "-o", tmp_path / "crop")
    async with running_service(database, data, kind_modules=()) as (http, service):
        jobs = Jobs(http)
        whole = await finished(http, service, {name: (source / name).read_bytes() for name in RUN_FILES})
        crop = await jobs.make("crop", {"where": "x > 0"}, whole)
        assert await jobs.read(crop, "scene.ply") == (tmp_path / "crop" / "scene.ply").read_bytes()
        assert await jobs.names(crop) == {*RUN_FILES, "edits.json"}
        left = len(read_gaussian_ply(tmp_path / "crop" / "scene.ply")[0])
        assert 0 < left < len(read_gaussian_ply(source / "scene.ply")[0])
        edits = json.loads(await jobs.read(crop, "edits.json"))
        assert edits == [{"operation": "crop", "where": "x > 0", "gaussians": left}]


@pytest.mark.exhaustive
async def test_jobs_give_the_scenes_of_the_commands(
    database: str,
    data: Path,
    tmp_path: Path,
    run: Path,  # noqa: F811
    worker: None,
) -> None:
    source = run / "run"
    scene, before = source / "scene.ply", read_gaussian_ply(source / "scene.ply")[0]
    count = len(before)
    right = int((before.means_world[:, 0] > 0).sum())
    assert 0 < right < count
    octasplat("export", source, tmp_path / "mesh.ply")
    octasplat("export", source, tmp_path / "a.splat")
    octasplat("crop", source, "--where", "x > 0", "-o", tmp_path / "crop")
    octasplat("export", tmp_path / "crop", tmp_path / "b.glb", "--for-viewers")
    octasplat("clean", source, "--min-opacity", 0.3, "-o", tmp_path / "clean.ply")
    octasplat("import", tmp_path / "a.splat", tmp_path / "imported.ply")
    octasplat(
        "transform", tmp_path / "crop", "--rotate", "z", 90, "--translate", 1, 2, 3, "-o", tmp_path / "moved"
    )
    (tmp_path / "c.obj").write_bytes(cube(0))
    (tmp_path / "d.obj").write_bytes(cube(1))
    deformed = ("--proxy", tmp_path / "c.obj", "--deformed", tmp_path / "d.obj", "--reach", "inf")
    octasplat("deform", source, *deformed, "-o", tmp_path / "deform.ply")

    async with running_service(database, data, kind_modules=()) as (http, service):
        jobs = Jobs(http)
        whole = await finished(http, service, {name: (source / name).read_bytes() for name in RUN_FILES})

        crop = await jobs.make("crop", {"where": "x > 0"}, whole)

        turn = {"rotate": [["z", 90]], "translate": [1, 2, 3]}
        moved = await jobs.make("transform", turn, crop)
        assert await jobs.read(moved, "scene.ply") == (tmp_path / "moved" / "scene.ply").read_bytes()
        means = read_gaussian_ply(tmp_path / "moved" / "scene.ply")[0].means_world
        x, y, z = before.means_world[before.means_world[:, 0] > 0].T
        np.testing.assert_allclose(means, np.stack([1 - y, 2 + x, 3 + z], axis=1), atol=1e-6)
        views = [ViewsRecord.model_validate_json(await jobs.read(job, "views.json")) for job in (crop, moved)]
        (x, y, z), seen = (
            np.stack([view.origin_world for view in record.viewpoints(None).views]).T for record in views
        )
        np.testing.assert_allclose(seen, np.stack([1 - y, 2 + x, 3 + z]), atol=1e-9)
        assert [edit["operation"] for edit in json.loads(await jobs.read(moved, "edits.json"))] == [
            "crop", "transform",
        ]  # fmt: skip
        shown = (await http.get(f"/jobs/{moved}/cameras.json")).json()["views"]
        assert len(shown) == len(views[1].views)  # the viewer has them where the scene is now
        places = {view["name"]: view["position"] for view in shown}
        for view in views[1].viewpoints(None).views:
            np.testing.assert_allclose(places[view.name], view.origin_world, atol=1e-5)
        refused = await http.post("/v1/jobs", json={"kind": "evaluate", "source_id": moved})
        assert refused.status_code == 422 and refused.json()["errors"][0]["pointer"] == "#/source_id"

        mirrored = await jobs.make("transform", {"scale": -1}, whole)
        assert await jobs.names(mirrored) == {"scene.ply", "edits.json"}

        edit = await jobs.make(
            "edit", {"meshes": ["m.ply"]}, whole, m__ply=(tmp_path / "mesh.ply").read_bytes()
        )
        assert await jobs.read(edit, "scene.ply") == scene.read_bytes()
        assert "config.json" in await jobs.names(edit)
        asked = {"proxy": "c.obj", "deformed": ["d.obj"], "reach": "inf"}
        meshes = {
            "c__obj": cube(0),
            "d__obj": cube(1),
        }
        deform = await jobs.make("deform", asked, whole, **meshes)
        assert await jobs.read(deform, "scene.ply") == (tmp_path / "deform.ply").read_bytes()
        lifted = read_gaussian_ply(tmp_path / "deform.ply")[0].means_world
        np.testing.assert_allclose(lifted, before.means_world + np.float32([0, 0, 1]), atol=1e-5)

        both = await jobs.make("merge", {"scenes": ["other.ply"]}, crop, other__ply=scene.read_bytes())
        (tmp_path / "both.ply").write_bytes(await jobs.read(both, "scene.ply"))
        assert len(read_gaussian_ply(tmp_path / "both.ply")[0]) == right + count

        clean = await jobs.make("clean", {"min_opacity": 0.3}, whole)
        assert await jobs.read(clean, "scene.ply") == (tmp_path / "clean.ply").read_bytes()

        await jobs.make("simplify", {"count": 20}, whole)

        options = {"files": ["b.glb", "b.spz", "b.splat", "b.obj"], "for_viewers": True}
        export = await jobs.make("export", options, crop)
        assert {"b.glb", "b.spz", "b.splat", "b.obj"} <= await jobs.names(export)
        assert await jobs.read(export, "b.glb") == (tmp_path / "b.glb").read_bytes()

        splat = (tmp_path / "a.splat").read_bytes()
        imported = await jobs.make("import", {"source": "a.splat"}, None, a__splat=splat)
        assert await jobs.read(imported, "scene.ply") == (tmp_path / "imported.ply").read_bytes()
        part = await jobs.make("crop", {"where": "x > 0"}, imported)  # a bare scene gives a bare scene
        assert await jobs.names(part) == {"scene.ply"}
        page = await http.get(f"/jobs/{imported}")
        assert page.status_code == 200 and "scene.ply" in page.text
    assert jobs.kinds == SCENE_KINDS


@pytest.mark.exhaustive
async def test_every_other_kind_of_job_succeeds(
    database: str,
    data: Path,
    run: Path,  # noqa: F811
    worker: None,
) -> None:
    async with running_service(database, data, kind_modules=()) as (http, _service):
        jobs = Jobs(http)
        dataset = await photographs(http, run / "scene")
        body = {"kind": "reconstruct", "dataset_id": dataset, "options": {**RUN_OPTIONS, "materials": True}}
        whole = await jobs.finish((await http.post("/v1/jobs", json=body)).json())
        assert {"scene.ply", "environment.hdr"} <= await jobs.names(whole)

        async def made(kind: str, options: dict[str, Any], **files: bytes) -> set[str]:
            return await jobs.names(await jobs.make(kind, options, whole, **files))

        assert {"metrics.json", "report.html", "renders/view_000.png"} <= await made("evaluate", {})
        assert await made("render", {**SMALL, "format": "mp4"}) == {"turntable.mp4"}
        assert len(await made("render", {**SMALL, "format": "png", "stage": STAGE})) == 2
        lit = {**SMALL, "format": "png", "environments": ["sky.hdr"], "samples": 1}
        assert len(await made("relight", lit, sky__hdr=HDR)) == 2
        assert await made("stage-init", {}) == {"stage.toml", "environment.exr"}
        assert "edits.json" in await made("material", {"set": {"roughness": 0.4}})
        assert await made("info", {}) == {"info.json", "picture.png"}
        surface = {"depth_side": 64, "texture_size": 64, "max_triangles": ["400"], "fit": False}
        assert "surface.glb" in await made("surface", surface)
        log = (await http.get(f"/v1/jobs/{whole}/logs")).json()
        assert "PermissionError" not in json.dumps(log)
    # Other tests of the same process register kinds of their own.
    ours = {kind.name for kind in job_kinds() if kind.program.startswith("octasplat.")}
    assert jobs.kinds | {"reconstruct"} == ours - SCENE_KINDS
