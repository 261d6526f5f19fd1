"""The pages in headless Chromium, on a real service with a real worker and a scene that it makes itself."""

import os
import shutil
import subprocess
import sys
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.pathtracing.stage.stage_file import parse_stage
from octasplat.engine.render.path_file import read_camera_path
from octasplat.engine.train.config import preset
from tests.support.web_harness import ROOT, Browse, RunningService, StartService
from tests.support.zip_builder import ZipMember, build_zip

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

VIEWS = 8
OPTIONS = {
    "train.iterations": 150,
    "train.max_gaussians": 800,
    "train.rays_per_batch": 1024,
    "train.initial_points": 600,
    "train.probe_rays": 256,
    "train.ssim_patch_side": 16,
    "train.checkpoint_every": 50,
    "test_every": 4,
}
"""Settings of a run of some seconds."""


@dataclass(frozen=True)
class Flow:
    """A scene that went through the browser, and the job that came of it."""

    service: RunningService
    folder: Path
    facts: dict[str, Any]
    job: str


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("generated") / "still life"
    config = SyntheticDatasetConfig(views=VIEWS, width_px=64, height_px=48, samples_per_side=1, points=800)
    write_synthetic_dataset(root, config)
    (root / "clip.MOV").write_bytes(b"film")
    return root


@pytest.fixture(scope="module")
def flow(start_service: StartService, browse: Browse, folder: Path, tmp_path_factory: Any) -> Flow:
    service = start_service()
    archive = Path(shutil.make_archive(str(tmp_path_factory.mktemp("zipped") / "photos"), "zip", folder))
    empty = archive.with_name("empty.zip")
    empty.write_bytes(build_zip(ZipMember("photos/a.HEIC", b"x"), ZipMember("photos/b.jpg", b"x")))
    facts = browse(
        "flow",
        service.url,
        folder=str(folder),
        archive=str(archive),
        empty=str(empty),
        first=5,
        options=OPTIONS,
        exports=["octagons.ply"],
    )
    return Flow(service, folder, facts, facts["job"])


@pytest.fixture(scope="module")
def watched(flow: Flow, browse: Browse, work: None) -> dict[str, Any]:
    """The job's page and the list while a worker does the job."""
    return browse("watch", flow.service.url, job=flow.job, seconds=400)


@pytest.fixture(scope="module")
def work(flow: Flow, database: str) -> Iterator[None]:
    """A worker that starts some seconds from now, so that waiting is seen too."""
    given = {"STORAGE": str(flow.service.store), "WORK": str(flow.service.store.parent / "work")}
    environment = {
        **os.environ,
        "DATABASE_URL": database,
        "OMP_NUM_THREADS": "1",
        "OCTASPLAT_THREADS": "1",
        "OCTASPLAT_FLOOR_BYTES": "0",
        **{f"OCTASPLAT_{key}": value for key, value in given.items()},
    }
    process = subprocess.Popen(
        [sys.executable, "-m", "octasplat", "worker", "--queues", "cpu", "--name", "w"],
        cwd=ROOT,
        env=environment,
    )
    yield
    process.terminate()
    process.wait(120)


@pytest.mark.exhaustive
def test_upload_page_resumes_after_interruption(flow: Flow) -> None:
    facts = flow.facts
    assert facts["empty"] == "Nothing here yet"
    what = f"{VIEWS} photographs and a COLMAP model"
    assert facts["chosen"]["text"].startswith(f"still life: {what}")
    notes = facts["chosen"]["notes"]
    assert "1 videos are left out (clip.MOV); save frames of them as photographs." in notes
    archived = facts["chosenArchive"]
    assert archived["text"].startswith(f"photos.zip, {what}") and archived["notes"] == notes
    assert facts["refused"][0].startswith("There are 1 photographs; at least 3 are needed")
    assert "(a.HEIC)" in facts["refused"][1]
    parts = [path for name in ("images", "sparse") for path in (flow.folder / name).rglob("*")]
    wanted = {path.relative_to(flow.folder).as_posix() for path in parts if path.is_file()}
    first, second = facts["firstPuts"], facts["secondPuts"]
    assert len(first) >= 5 and len(second) == len(wanted) - 5  # just what had not arrived
    job = flow.service.request("GET", f"/v1/jobs/{flow.job}")
    dataset = flow.service.request("GET", f"/v1/datasets/{job['dataset_id']}")
    files = flow.service.request("GET", f"/v1/datasets/{dataset['id']}/files")["files"]
    assert {file["path"] for file in files} == wanted
    assert dataset["name"] == "still life" and dataset["photographs"] == VIEWS and dataset["has_poses"]
    assert (
        len(flow.service.request("GET", "/v1/datasets")["datasets"]) == 1
    )  # the second time found the first
    assert facts["complaints"] == []


def test_form_submits_filled_values(flow: Flow) -> None:
    job = flow.service.request("GET", f"/v1/jobs/{flow.job}")
    options = job["options"]
    assert job["label"] == "a still life"
    assert options["preset"] == "fast" and options["poses"] == "given" and options["test_every"] == 4
    assert options["exports"] == ["octagons.ply"]
    assert options["train"]["iterations"] == 150 and options["train"]["rays_per_batch"] == 1024
    # Of the preset, as the field was left empty.
    assert options["train"]["sh_degree_interval"] == preset("fast").sh_degree_interval
    assert flow.facts["iterationsHint"] == str(preset("fast").iterations)  # the hint follows the preset
    assert flow.facts["namelessOnNew"] == []


def test_new_job_form_shows_estimate(flow: Flow) -> None:
    facts = flow.facts
    for shown in (facts["estimate"], facts["estimateAnew"]):
        assert shown.startswith("This takes about ") and shown.endswith(", within a factor of two.")
    assert facts["estimate"] != facts["estimateAnew"]  # other options, another time
    assert facts["tooMuch"].startswith("Iterations: ") and "100000" in facts["tooMuch"]
    job = flow.service.request("GET", f"/v1/jobs/{flow.job}")
    assert facts["estimateAnew"] == f"This takes {job['estimate']['text']}, within a factor of two."


def test_job_page_follows_progress_to_end(watched: dict[str, Any]) -> None:
    states = watched["states"]
    assert states[-1] == "succeeded" and "running" in states, states
    assert watched["list"][-1] == "Done"
    assert watched["stages"], "no stage was shown by its name"
    assert watched["liveCurves"] == 3 and watched["curves"] == 3
    assert "held-out views" in watched["figures"][0] and "training rays" in watched["figures"][0]
    assert "Trained 150 iterations in" in watched["log"] and "Attempt 1" in watched["log"]
    assert watched["preview"]
    assert watched["view"]["deviation"] > 15  # there is a picture in the viewer
    assert watched["nameless"] == []
    assert watched["overflow"] <= 0
    assert watched["complaints"] == []


def test_job_page_shows_result(flow: Flow, watched: dict[str, Any], browse: Browse) -> None:
    found = browse("result", flow.service.url, job=flow.job)
    assert found["worstFirst"] == sorted(found["worstFirst"]) and len(found["worstFirst"]) == 2
    assert found["bestFirst"] == found["worstFirst"][::-1]
    assert found["byName"] == sorted(found["byName"])
    assert found["shown"] == found["byName"][1]
    assert found["boxes"][0] == found["boxes"][1]  # photograph and render lie on each other
    assert found["download"] == "metrics.json"
    assert "report" in found["report"]
    assert found["reportRuns"] and found["reportOrigin"] == "null"  # its script runs, as nobody
    assert found["viewerReady"] and found["complaints"] == []


@pytest.mark.exhaustive
def test_stage_form_renders_with_added_mesh(
    flow: Flow, watched: dict[str, Any], browse: Browse, tmp_path: Path
) -> None:
    mesh = tmp_path / "a thing.obj"
    mesh.write_text("v 0 0 0\nv 2 0 0\nv 0 2 0\nv 0 0 2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    found = browse("light", flow.service.url, job=flow.job, mesh=str(mesh))
    before, stage = (
        parse_stage(found[name].replace("a_thing.obj", "x.obj"), name) for name in ("first", "placed")
    )
    assert before.meshes[0].shape == "sphere" and before.lights[0].kind == "directional"
    thing, floor = stage.meshes
    assert thing.file == "x.obj" and floor.shape == "plane" and stage.lights[0].kind == "rectangle"
    assert thing.on is not None and thing.on.pixel == pytest.approx((0.25 * 64, 0.745 * 48), abs=1)
    assert found["refused"].startswith("'sky.hdr' is not an image") and found["refused"].count("sky.hdr") == 1
    assert found["preview"] == [64, 48] and found["took"].startswith("The preview took ")
    assert len(found["pictures"]) == 2 and set(found["pictures"]) == {64}
    job = flow.service.request("GET", f"/v1/jobs/{found['job']}")
    assert (job["kind"], job["source_id"], job["state"]) == ("render", flow.job, "succeeded")
    assert len(job["options"]["stage"]["meshes"]) == 2
    files = flow.service.request("GET", f"/v1/datasets/{job['files_id']}/files")["files"]
    assert [file["path"] for file in files] == ["a_thing.obj"]
    assert found["estimate"].startswith("With 100,000 Gaussians the held-out views would take at most about ")
    assert found["saved"] == {"name": "stage.toml", "same": True}
    assert found["left"] == 0 and found["nameless"] == []
    assert [
        text for text in found["complaints"] if "422" not in text
    ] == []  # one file is meant to be refused


@pytest.mark.exhaustive
def test_pages_are_usable_by_keyboard(
    flow: Flow, watched: dict[str, Any], browse: Browse, tmp_path: Path
) -> None:
    found = browse("keyboard", flow.service.url, job=flow.job)
    assert found["first"] == "Skip to the content"
    assert found["keepsFocus"]
    assert all(found["changes"].values()), found["changes"]
    assert found["place"].startswith("view_")
    assert found["flies"] == "true" and found["back"]
    (tmp_path / "path.json").write_text(found["path"])
    cameras = read_camera_path(tmp_path / "path.json").cameras
    assert len(cameras) == 60 and cameras[0].height_px == 720
    views = {
        view["name"]: view for view in flow.service.request("GET", f"/jobs/{flow.job}/cameras.json")["views"]
    }
    # The first key is where the photograph was taken from that the place names.
    np.testing.assert_allclose(
        cameras[0].centre_world, views[found["place"].split(" ")[0]]["position"], atol=1e-4
    )
    forward = cameras[0].rotation_cam_from_world[2]
    np.testing.assert_allclose(forward, views[found["place"].split(" ")[0]]["forward"], atol=1e-4)
    assert found["sorted"] == "descending"
    assert found["cut"] == "0%"
    assert found["chooser"] is True
    assert found["complaint"] == "Choose photographs first."
    assert found["complaints"] == []


def test_pages_fit_phone_in_both_color_schemes(flow: Flow, watched: dict[str, Any], browse: Browse) -> None:
    found = browse("phone", flow.service.url, job=flow.job)
    assert {name: width for name, width in found["overflow"].items() if width > 0} == {}
    for name, color in found["background"].items():
        channels = [int(part) for part in color[4:-1].split(",")]
        assert (max(channels) < 60) if name.endswith("dark") else (min(channels) > 200), name
    assert found["touchTurns"]
    assert [
        text for text in found["complaints"] if "404" not in text
    ] == []  # one page is meant to be missing


@pytest.mark.exhaustive
def test_buttons_and_polling_without_events(flow: Flow, browse: Browse) -> None:
    dataset = flow.service.request("GET", f"/v1/jobs/{flow.job}")["dataset_id"]
    # A queue that nobody works on.
    body = {"dataset_id": dataset, "queue": "nobody", "options": {"preset": "fast"}}
    jobs = [flow.service.request("POST", "/v1/jobs", body)["id"] for _ in range(2)]
    found = browse("actions", flow.service.url, jobs=jobs)
    assert found["asked"] == "Delete this job and its results?"
    assert found["gone"] and found["polled"]
    assert flow.service.request("GET", f"/v1/jobs/{uuid.UUID(jobs[0])}")["state"] == "canceled"
    assert found["complaints"] == []


def test_pages_ask_for_token(start_service: StartService, browse: Browse) -> None:
    service = start_service()
    found = browse("signIn", service.url)
    assert found["sentTo"] == "/sign-in?next=/new"
    assert found["refused"] == "This token is not valid (any more)."
    assert found["cookie"] == {"httpOnly": True, "sameSite": "Strict"} and found["readable"] == ""
    assert found["api"] == "admin" and found["after"] == 401
    assert [text for text in found["complaints"] if "401" not in text and "403" not in text] == []
