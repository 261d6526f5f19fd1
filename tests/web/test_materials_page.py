"""The page of a result with materials: what lies behind its views, another light, other materials."""

import shutil
import urllib.request
import uuid
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.render.environment_files import write_environment
from octasplat.workers.cli.main import cli
from tests.support.service_harness import BEARER, TOKEN
from tests.support.web_harness import Browse, RunningService

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

RUN = (
    "--preset",
    "fast",
    "--iterations",
    "30",
    "--rays-per-batch",
    "256",
    "--max-gaussians",
    "300",
    "--threads",
    "1",
    "--set",
    "initial_points=200",
    "--set",
    "probe_rays=256",
    "--test-every",
    "4",
    "--exports",
    "",
    "--materials",
    "--set",
    "materials.environment_height=16",
    "--set",
    "materials.ambient_occlusion_rays=4",
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene, a run of it with materials, and a map of light."""
    root = tmp_path_factory.mktemp("shiny")
    config = SyntheticDatasetConfig(views=8, width_px=64, height_px=48, samples_per_side=1, points=400)
    write_synthetic_dataset(root / "scene", config)
    done = CliRunner().invoke(cli, ["reconstruct", str(root / "scene"), "-o", str(root / "run"), *RUN, "-q"])
    assert done.exit_code == 0, done.output
    write_environment(root / "a map.hdr", np.full((8, 16, 3), 0.5, np.float32))
    return root


@pytest.fixture(scope="module")
def job(service: RunningService, folder: Path) -> str:
    """A reconstruction that nobody has worked on yet."""
    command = ("submit", folder / "scene", "--queue", "nobody", "--server", service.url, "-q")
    done = CliRunner().invoke(cli, [str(part) for part in command], env={"OCTASPLAT_TOKEN": TOKEN})
    assert done.exit_code == 0, done.output
    return done.stdout.strip().splitlines()[-1]


def page_of(service: RunningService, job: str) -> str:
    """The page of a job, as text."""
    page = urllib.request.Request(f"{service.url}/jobs/{job}", headers=BEARER)
    with urllib.request.urlopen(page, timeout=60) as answer:
        text: str = answer.read().decode()
    return text


@pytest.mark.exhaustive
def test_materials_page_offers_layers_relight_and_edit(
    service: RunningService, browse: Browse, folder: Path, job: str
) -> None:
    service.worker.run(uuid.UUID(job), folder / "run")
    # the form of a stage begins with the light that was learnt
    assert (
        '<select id="light-scene" name="scene" aria-describedby="light-scene-help"><option value="learnt">'
        in (page_of(service, job))
    )
    found = browse("relight", service.url, job=job, map=str(folder / "a map.hdr"), by="path")

    worst, other = found["render"][0].removeprefix("renders/"), found["other"][0].rpartition("/")[2]
    assert found["learnt"] == ["layers/environment.png", 32, 16]
    shown = [name for name, *_ in found["layers"]]
    assert shown == [
        "Normals",
        "Depth",
        "Base color",
        "Metallic",
        "Roughness",
        "Visibility",
        "Indirect light",
    ]
    first = {address.rpartition("/")[2] for _, address, *_ in found["layers"]}
    assert len(first) == 1 and first != {other} and worst == other  # the other row was chosen after these
    assert [address.split("/")[1] for _, address, *_ in found["layers"]][2:4] == ["albedo", "metallic"]
    assert {tuple(size) for _, _, *size in found["layers"]} == {(64, 48)} and found["tag"] == "Indirect light"

    first, lit, learnt, plain = found["looks"]
    assert first == learnt and abs(lit - plain) > 0.05 and learnt != lit != plain != learnt
    assert found["hidden"] and found["refused"] == "Choose a file of light: HDR or EXR."
    relit, film, changed = (
        service.request("GET", f"/v1/jobs/{found[k]}") for k in ("first", "second", "third")
    )
    assert relit["kind"] == film["kind"] == "relight" and relit["source_id"] == film["source_id"] == job
    wanted = {"environments": ["a_map.hdr"], "rotation_degrees": 90, "mode": "views", "integrator": "path"}
    assert wanted.items() <= relit["options"].items() and relit["options"]["samples"] == 64
    assert film["files_id"] == relit["files_id"] and found["maps"] == ["A file of yours", "a_map.hdr (light)"]
    assert film["options"]["spin"] and film["options"]["mode"] == "turntable"
    assert changed["kind"] == "material" and changed["options"]["where"] == "metallic > 0.5"
    assert changed["options"]["set"]["albedo"][0] == 1 and changed["options"]["multiply"]["roughness"] == 0.5
    assert found["nameless"] == [] and found["overflow"] <= 0 and found["complaints"] == []


@pytest.mark.exhaustive
def test_result_without_materials_has_no_materials_page(
    service: RunningService, folder: Path, job: str, tmp_path: Path
) -> None:
    dataset = service.request("GET", f"/v1/jobs/{job}")["dataset_id"]
    plain = service.request("POST", "/v1/jobs", {"dataset_id": dataset, "queue": "nobody"})["id"]
    left_out = shutil.ignore_patterns("environment.hdr", "layers")
    shutil.copytree(folder / "run", tmp_path / "run", ignore=left_out)
    service.worker.run(uuid.UUID(plain), tmp_path / "run")
    text = page_of(service, plain)
    assert "Held-out views" in text
    assert '<select id="light-scene" name="scene"><option value="shadowed">' in text
    for part in ('id="relight"', 'data-kind="material"', "Base color, times"):
        assert part not in text
