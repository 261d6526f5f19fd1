"""A training is watched in 3D on its page; its result is measured, annotated and cropped there."""

import json
import shutil
import threading
import uuid
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.edit.cleaning import clean
from octasplat.engine.edit.edit_options import Selection
from octasplat.engine.edit.selection import selection_mask
from octasplat.engine.files import read_scene
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.operations.clean import CleanOptions
from octasplat.engine.runs.run_folder import run_camera_clearance
from octasplat.workers.cli.main import cli
from octasplat.workers.worker.live_scene import heaviest
from tests.support.npm_packages import npm_folder
from tests.support.service_harness import TOKEN
from tests.support.web_harness import Browse, RunningService

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

RUN = (
    "--preset", "fast", "--iterations", "60", "--rays-per-batch", "256", "--max-gaussians", "500",
    "--threads", "1", "--set", "initial_points=400", "--set", "probe_rays=256", "--test-every", "4",
    "--exports", "", "-q",
)  # fmt: skip
AXE = ("axe-core", "4.10.3")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene with a photograph that has no place, a run of it, and a state of its training."""
    root = tmp_path_factory.mktemp("live")
    config = SyntheticDatasetConfig(views=8, width_px=96, height_px=72, samples_per_side=1, points=500)
    write_synthetic_dataset(root / "scene", config)
    shutil.copy(root / "scene" / "images" / "view_000.png", root / "scene" / "images" / "without a place.png")
    done = CliRunner().invoke(cli, ["reconstruct", str(root / "scene"), "-o", str(root / "run"), *RUN])
    assert done.exit_code == 0, done.output
    write_gaussian_ply(heaviest(read_scene(root / "run" / "scene.ply")[0], 200), root / "state.ply")
    return root


@pytest.fixture(scope="module")
def job(service: RunningService, folder: Path) -> uuid.UUID:
    """A reconstruction that nobody has worked on yet."""
    command = ("submit", folder / "scene", "--queue", "nobody", "--server", service.url, "-q")
    done = CliRunner().invoke(cli, [str(part) for part in command], env={"OCTASPLAT_TOKEN": TOKEN})
    assert done.exit_code == 0, done.output
    return uuid.UUID(done.stdout.strip().splitlines()[-1])


@pytest.fixture(scope="module")
def axe() -> str:
    return str(npm_folder(*AXE) / "node_modules" / "axe-core")


def test_training_is_watched_in_3d(
    service: RunningService, browse: Browse, folder: Path, job: uuid.UUID, axe: str, tmp_path: Path
) -> None:
    service.worker.run(job, folder / "run", until=30)
    is_over = threading.Event()

    def tell_states() -> None:
        for signal, step in (("opened", 0), ("points", 30)):
            while not (tmp_path / signal).exists():  # what the page has seen so far
                if is_over.wait(0.05):
                    return
            service.worker.show_live(
                job, folder / "state.ply", folder / "run" / "views.json", step=step, gaussians=200
            )

    states = threading.Thread(target=tell_states)
    states.start()
    try:
        found = browse("live", service.url, job=str(job), axe=axe, signals=str(tmp_path))
    finally:
        is_over.set()
        states.join()
    assert found["complaints"] == [] and found["faults"] == []
    assert found["before"] == "The scene appears here as soon as the poses of the photographs are known."
    assert found["count"] == "Step 30, 200 Gaussians"
    assert len(found["views"]) == 9 and found["views"][0] == "8 photographs"
    held_out = json.loads((folder / "run" / "held_out.json").read_text())
    assert [name for name in found["views"] if "held out" in name] == [
        f"{name} (held out)" for name in held_out
    ]
    assert found["unplaced"] == ["1 photograph was not placed", "without a place.png"]
    assert found["overlayDraws"] == 1
    assert found["marks"][0] == 0 < found["marks"][1]
    assert found["place"] == f"{held_out[0]} (held out)"
    photograph = found["photograph"]
    assert (photograph["alt"], photograph["width"]) == (f"Photograph {held_out[0]}", 96)
    assert photograph["ratio"] == pytest.approx(96 / 72, rel=0.01) and photograph["covers"] <= 1.01
    assert found["corner"]


@pytest.mark.exhaustive
def test_result_is_measured_annotated_and_cropped(
    service: RunningService, browse: Browse, folder: Path, axe: str
) -> None:
    command = ("submit", folder / "scene", "--queue", "nobody", "--server", service.url, "-q")
    done = CliRunner().invoke(cli, [str(part) for part in command], env={"OCTASPLAT_TOKEN": TOKEN})
    result = uuid.UUID(done.stdout.strip().splitlines()[-1])
    service.worker.run(result, folder / "run")
    found = browse("edit", service.url, seconds=150, job=str(result), axe=axe)
    assert found["complaints"] == [] and found["faults"] == []
    distance, words = found["distance"]
    assert 0 < distance < 10 and words == f"Distance {distance:.4g} in the scene's units"
    assert found["notes"] == ["the middle <b>"]
    numbers = [[float(x) for x in link.removeprefix("#view=").split(",")] for link in found["links"]]
    np.testing.assert_allclose(numbers[0], numbers[1], rtol=1e-3, atol=1e-3)
    scene = read_scene(folder / "run" / "scene.ply")[0]
    keep, report = clean(scene, CleanOptions(), run_camera_clearance(folder / "run", 0.25))
    assert found["cleaned"]["kept"] == keep.sum() and found["cleaned"]["faint"] == report.faint
    queued = service.request("GET", f"/v1/jobs/{found['job']}")
    assert queued["kind"] == "crop" and queued["source_id"] == str(result)
    kept = selection_mask(scene, Selection(box=queued["options"]["box"]), (0.0, 0.0, 0.0))
    assert found["cropped"]["kept"] == kept.sum() < len(scene)
    assert found["said"].startswith(f"{kept.sum()} Gaussians stay; {(~kept).sum()} outside the box")
    assert found["differs"] > 1
    region = np.array(found["region"].split(), float)
    np.testing.assert_allclose(region, queued["options"]["box"], rtol=1e-4, atol=1e-4)
    assert found["regionShown"]
    notes = service.request("GET", f"/v1/jobs/{result}")["view_notes"]
    assert [note["text"] for note in notes] == ["the middle <b>"] and len(notes[0]["camera"]) == 6


def test_pages_around_jobs_are_accessible_and_presets_say_what_they_take(
    service: RunningService, browse: Browse, folder: Path, job: uuid.UUID, axe: str
) -> None:
    dataset = service.request("GET", f"/v1/jobs/{job}")["dataset_id"]
    two = []
    for name, side in (("small", 64), ("large", 96)):
        options = {"preset": "fast", "max_side": side}
        body = {"dataset_id": dataset, "label": name, "options": options, "queue": "nobody"}
        two.append(service.request("POST", "/v1/jobs", body)["id"])
        service.worker.run(uuid.UUID(two[-1]), folder / "run")
    paths = {
        "jobs": "/?order=psnr",
        "new": f"/new?dataset={dataset}",
        "admin": "/admin",
        "compare": f"/compare?job={two[0]}&job={two[-1]}",
    }
    found = browse("portraits", service.url, paths=paths, axe=axe)
    assert found["complaints"] == []
    assert found["faults"] == {name: [] for name in paths}
    compared = {row[0]: row[1:] for row in found["compared"]}
    psnr = json.loads((folder / "run" / "metrics.json").read_text())["mean"]["psnr"]
    assert compared["Held-out PSNR"] == [f"{psnr:.2f} dB"] * 2 and compared["max_side"] == ["64", "96"]
    assert "preset" not in compared
    assert all("of memory" in text for text in found["estimates"])
    shown = found["estimates"][2]  # of the preset that was chosen then
    assert found["chosen"] == f"This takes {shown[:1].lower()}{shown[1:]}, within a factor of two."


@pytest.mark.exhaustive
def test_several_archives_become_a_job_each(
    service: RunningService, browse: Browse, folder: Path, tmp_path: Path
) -> None:
    names = ("gate", "pond")
    archives = [shutil.make_archive(str(tmp_path / name), "zip", folder / "scene") for name in names]
    found = browse("many", service.url, archives=archives)
    assert found["complaints"] == []
    assert found["chosen"].startswith("2 scenes, a job each, ")
    assert found["button"] == "Upload and start 2 jobs"
    listed = [note.split(",")[:2] for note in found["notes"] if ".zip," in note]
    assert listed == [[f"{name}.zip", " 9 photographs and a COLMAP model"] for name in names]
    assert found["names"][:2] == ["evening: pond", "evening: gate"]
    [newest, *_] = service.request("GET", "/v1/jobs")["jobs"]
    assert service.request("GET", f"/v1/jobs/{newest['id']}")["options"]["preset"] == "fast"


@pytest.mark.exhaustive
def test_cancelled_job_goes_on_with_other_files(
    service: RunningService, browse: Browse, folder: Path
) -> None:
    command = ("submit", folder / "scene", "--queue", "nobody", "--server", service.url, "-q")
    done = CliRunner().invoke(cli, [str(part) for part in command], env={"OCTASPLAT_TOKEN": TOKEN})
    job = done.stdout.strip().splitlines()[-1]
    service.request("POST", f"/v1/jobs/{job}/cancel")
    found = browse("goOn", service.url, job=job)
    assert found["complaints"] == []
    revised = service.request("GET", f"/v1/jobs/{job}")
    assert revised["state"] == "queued" and "scene.spz" in revised["options"]["exports"]


def test_box_on_the_form_begins_with_the_gaussians_of_a_job(
    service: RunningService, browse: Browse, folder: Path, job: uuid.UUID, axe: str
) -> None:
    dataset = service.request("GET", f"/v1/jobs/{job}")["dataset_id"]
    body = {"dataset_id": dataset, "options": {"preset": "fast", "max_side": 64}, "queue": "nobody"}
    result = service.request("POST", "/v1/jobs", body)["id"]
    service.worker.run(uuid.UUID(result), folder / "run")
    found = browse("begin", service.url, job=result, axe=axe)
    assert found["complaints"] == [] and found["faults"] == []
    assert found["words"] == "Begin with the Gaussians of this job"
    assert found["source"] == "The job that this one begins with"
    queued = service.request("GET", f"/v1/jobs/{found['job']}")
    assert (queued["source_id"], queued["dataset_id"]) == (result, dataset)
    assert queued["options"]["max_side"] == 64
