"""Jobs that change scenes, merge, import and export them: the scenes of the commands, and of further jobs."""

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
from test_reconstruction import ROOT
from test_stage_jobs import HDR, finished, run, sent  # noqa: F401 (a fixture)

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.dataset.views_file import ViewsRecord
from octasplat.engine.files.gaussian_ply import read_gaussian_ply
from octasplat.workers.cli.main import cli
from octasplat.workers.cli.named_files import with_named_files
from octasplat.workers.client.submission import Derivation
from tests.support.service_harness import running_service

RUN_FILES = ("scene.ply", "config.json", "held_out.json", "views.json", "training.json")
CUBE = [(x, y, z) for x in (-9, 9) for y in (-9, 9) for z in (-9, 9)]
CUBE_FACES = [
    (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
    (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
]  # fmt: skip


def octasplat(*arguments: object) -> None:
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == 0, done.output


async def test_scene_job_invalid_options_are_refused_before_queueing(conninfo: str, tmp_path: Path) -> None:
    async with running_service(conninfo, tmp_path) as (http, service):
        source = await finished(http, service, {"scene.ply": b"ply"})
        files = await sent(http, {"a.ply": b"ply\n", "sky.hdr": HDR, "turn.txt": b"1 0 0 0"})
        on = {"source_id": source, "files_id": files}
        for body, pointer, words in (
            ({"kind": "import", "options": {"file": "a.ply"}}, "#/files_id", "works on files_id"),
            ({"kind": "import", "options": {"file": "a.ply"}, **on}, "#/source_id", "files_id alone"),
            (
                {"kind": "import", "options": {"file": "b.ply"}, "files_id": files},
                "#/options/file",
                "there is no file 'b.ply'",
            ),
            ({"kind": "edit", "options": {}, **on}, "#/options/meshes", "required"),
            ({"kind": "edit", "options": {"meshes": ["c.ply"]}, **on}, "#/options/meshes/0", "'c.ply'"),
            ({"kind": "deform", "options": {"proxy": "p.obj", "deformed": ["a.ply"]}, **on},
             "#/options/proxy", "'p.obj'"),
            ({"kind": "merge", "options": {}, **on}, "#/options/", "at least two scenes"),
            ({"kind": "transform", "options": {}, **on}, "#/options/", "Say what to do"),
            ({"kind": "transform", "options": {"matrix": "no.txt"}, **on}, "#/options/matrix", "no.txt"),
            ({"kind": "crop", "options": {}, "source_id": source}, "#/options/", "Say what to keep"),
            ({"kind": "crop", "options": {"where": "x > 0"}, **on}, "#/files_id", "take no files"),
            ({"kind": "export", "options": {"files": ["a.obj"], "opaque": True}, "source_id": source},
             "#/options/", "opaque is for GLB"),
        ):  # fmt: skip
            refused = await http.post("/v1/jobs", json=body)
            assert refused.status_code == 422, (body, refused.text)
            [fault] = refused.json()["errors"]
            assert fault["pointer"] == pointer and words in fault["detail"], fault
        made = await http.post(
            "/v1/jobs", json={"kind": "transform", "options": {"matrix": "turn.txt"}, **on}
        )
        assert made.status_code == 202 and made.json()["dataset_id"] is None
        kinds = {kind["name"]: kind["needs"] for kind in (await http.get("/v1/options")).json()["kinds"]}
        assert kinds["import"] == "files" and kinds["edit"] == "result"


def test_local_files_are_sent_under_option_names(tmp_path: Path) -> None:
    for name in ("f1.ply", "f10.ply", "f2.ply", "p.obj"):
        (tmp_path / name).write_bytes(b"x")
    given = [("deformed", tmp_path / "f*.ply"), ("proxy", tmp_path / "p.obj")]
    what = with_named_files(Derivation("j", "deform"), given)
    assert what.options == {"deformed": ["f1.ply", "f2.ply", "f10.ply"], "proxy": "p.obj"}
    assert set(what.files) == {"f1.ply", "f2.ply", "f10.ply", "p.obj"}
    with pytest.raises(ConfigError, match="proxy: takes one file, and 3 are given"):
        with_named_files(Derivation("j", "deform"), [("proxy", tmp_path / "f*.ply")])
    with pytest.raises(ConfigError, match="no such file"):
        with_named_files(Derivation("j", "merge"), [("scenes", tmp_path / "none.ply")])


@pytest.fixture
def worker(conninfo: str, tmp_path: Path) -> Iterator[None]:
    """A worker, as a program of its own."""
    given = {
        "STORAGE": tmp_path / "store", "WORK": tmp_path / "work", "FLOOR_BYTES": 0, "THREADS": 1,
        "POLL_SECONDS": 0.15,
    }  # fmt: skip
    environment = {f"OCTASPLAT_{key}": str(value) for key, value in given.items()}
    process = subprocess.Popen(
        [sys.executable, "-m", "octasplat", "worker", "--queues", "cpu"],
        cwd=ROOT, env={**os.environ, **environment, "DATABASE_URL": conninfo, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    yield
    process.kill()
    process.wait(120)


class Jobs:
    """Asks for jobs, waits for them and reads their results."""

    def __init__(self, http: httpx.AsyncClient) -> None:
        self.http = http

    async def make(self, kind: str, options: dict[str, Any], source: str | None, **files: bytes) -> str:
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
            await asyncio.sleep(0.1)
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


@pytest.mark.heavy
async def test_jobs_give_the_scenes_of_the_commands(
    conninfo: str,
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
    for name, height in (("c.obj", 0), ("d.obj", 1)):
        lines = [f"v {x} {y} {z + height}" for x, y, z in CUBE]
        lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in CUBE_FACES]
        (tmp_path / name).write_text("\n".join(lines) + "\n")
    deformed = ("--proxy", tmp_path / "c.obj", "--deformed", tmp_path / "d.obj", "--reach", "inf")
    octasplat("deform", source, *deformed, "-o", tmp_path / "deform.ply")

    async with running_service(conninfo, tmp_path, kind_modules=()) as (http, service):
        jobs = Jobs(http)
        whole = await finished(http, service, {name: (source / name).read_bytes() for name in RUN_FILES})

        crop = await jobs.make("crop", {"where": "x > 0"}, whole)
        assert await jobs.read(crop, "scene.ply") == (tmp_path / "crop" / "scene.ply").read_bytes()
        assert await jobs.names(crop) == {*RUN_FILES, "edits.json"}
        edits = json.loads(await jobs.read(crop, "edits.json"))
        assert edits == [{"operation": "crop", "where": "x > 0", "gaussians": right}]

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
            "c__obj": (tmp_path / "c.obj").read_bytes(),
            "d__obj": (tmp_path / "d.obj").read_bytes(),
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

        options = {"files": ["b.glb"], "for_viewers": True}
        export = await jobs.make("export", options, crop)
        assert await jobs.read(export, "b.glb") == (tmp_path / "b.glb").read_bytes()

        splat = (tmp_path / "a.splat").read_bytes()
        imported = await jobs.make("import", {"file": "a.splat"}, None, a__splat=splat)
        assert await jobs.read(imported, "scene.ply") == (tmp_path / "imported.ply").read_bytes()
        part = await jobs.make("crop", {"where": "x > 0"}, imported)  # a bare scene gives a bare scene
        assert await jobs.names(part) == {"scene.ply"}
        page = await http.get(f"/jobs/{imported}")
        assert page.status_code == 200 and "scene.ply" in page.text
