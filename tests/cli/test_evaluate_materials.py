"""A run with materials, measured against a truth: by views, its environment, and in other light."""

import json
import shutil
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from pydantic import ValidationError

from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.render.environment_files import write_environment
from octasplat.engine.render.image_files import read_image
from octasplat.workers.worker.handlers import run_operation
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.task import Task

SIDE = (48, 64)


def save(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.ascontiguousarray(values if values.ndim == 3 else values[..., None], np.uint8)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), oiio.ImageSpec(image.shape[1], image.shape[0], image.shape[2], "uint8"))
    assert output.write_image(image)
    output.close()


@pytest.fixture(scope="module")
def scene_with_truth(run, tmp_path_factory) -> Path:
    """A folder with a third of the photographs as its test, and what is said to be true of one of them."""
    root = tmp_path_factory.mktemp("known")
    shutil.copytree(run.scene, root / "test")
    view = "view_000.png"
    text = {
        "name": "still life",
        "environment": {"train": "day", "relight": ["dim"]},
        "test": {"truth_views": [view], "albedo": "sRGB", "roughness": "v/255", "metallic": "v/255"},
        "relight": {"folders": ["relight/dim"], "views": [view]},
    }
    (root / "truth.json").write_text(json.dumps(text))
    write_environment(root / "env" / "day.hdr", np.full((16, 32, 3), 1.0, np.float32))
    write_environment(root / "env" / "dim.hdr", np.full((16, 32, 3), 0.25, np.float32))
    mask = np.zeros(SIDE)
    mask[20:28, 28:36] = 255
    save(root / "test" / "mask" / view, mask)
    save(root / "test" / "albedo" / view, np.full((*SIDE, 3), 188))  # 0.5 in linear light
    save(root / "test" / "roughness" / view, np.full(SIDE, 0.4 * 255))
    save(root / "test" / "metallic" / view, np.full(SIDE, 255))
    save(root / "relight" / "dim" / view, np.full((*SIDE, 4), [60, 60, 60, 255]))
    return root


@pytest.mark.exhaustive
def test_materials_light_and_relit_pictures_are_measured(shiny_run, scene_with_truth, octasplat):
    done = octasplat("evaluate", shiny_run, "--other-dataset", scene_with_truth / "test")
    assert done.exit_code == 0, done.output
    metrics = json.loads((shiny_run / "on" / "test" / "metrics.json").read_text())
    mean = metrics["truth"]["mean"]
    assert mean["roughness_mae"] == pytest.approx(0.1, abs=0.005)
    assert mean["metallic_mae"] == pytest.approx(0.0, abs=1e-3)
    assert mean["albedo_scales"] == pytest.approx([2.0] * 3, rel=0.02)
    assert mean["albedo_psnr_scaled"] > 40 > 20 > mean["albedo_psnr"]
    assert mean["environment_scales"] == pytest.approx([2.0] * 3, rel=0.02)
    assert mean["environment_psnr_scaled"] > 40
    assert set(mean["relight"]) == {"dim"} and mean["relight"]["dim"]["views"] == 1
    assert mean["relight_psnr_scaled"] >= mean["relight_psnr"] - 1e-6
    assert "Against the truth" in done.output
    report = (shiny_run / "on" / "test" / "report.html").read_text()
    for tab in ("normal", "depth", "albedo", "metallic", "roughness", "visibility", "indirect"):
        assert f'data-pair="photograph {tab}"' in report
    assert 'id="environment"' in report


@pytest.mark.exhaustive
def test_relight_run_at_own_and_other_views(shiny_run, scene_with_truth, octasplat, tmp_path):
    dim = scene_with_truth / "env" / "dim.hdr"
    done = octasplat("relight", shiny_run, "--environment", dim, "-o", tmp_path / "own", "--samples", 1)
    assert done.exit_code == 0, done.output
    own = json.loads((shiny_run / "metrics.json").read_text())["views"]
    assert {path.stem for path in (tmp_path / "own").iterdir()} == {Path(name).stem for name in own}
    done = octasplat(
        "relight", shiny_run, "--environment", dim, "-o", tmp_path / "on", "--samples", 1, "--other-dataset",
        scene_with_truth / "test",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert len(list((tmp_path / "on").iterdir())) == 8
    picture = read_image(tmp_path / "on" / "view_000.png")
    assert (picture == read_image(tmp_path / "own" / "view_000.png")).all()
    assert (
        picture.max() < 0.5
    )  # 0.25 is 0.54 in display values, and rough metal of albedo 0.25 sends back less


@pytest.mark.exhaustive
def test_relight_job_uses_uploaded_files(shiny_run, scene_with_truth, tmp_path):
    shutil.copytree(shiny_run, tmp_path / "attempt" / "run")
    shutil.copytree(scene_with_truth / "env", tmp_path / "attempt" / "files" / "maps")
    kind = get_job_kind("relight")
    asked = {"environments": ["maps/day.hdr", "maps/dim.hdr"], "mode": "views", "format": "png", "samples": 1}
    options = kind.resolve(asked)
    assert [name for _, name in kind.named_files(options)] == asked["environments"]
    size = ImageSizes(64, 48, 8)
    assert {demand.resource: demand.amount for demand in kind.resource_demands(options, [size])} == {
        "render_pixels": 2 * 8 * 64 * 48, "render_paths": 2 * 8 * 64 * 48,
        "workspace_bytes": round(0.4 * 2 * 8 * 64 * 48),
    }  # fmt: skip
    run_operation(Task(tmp_path / "attempt", options.model_dump(mode="json"), threads=1, kind="relight"))
    views = tmp_path / "attempt" / "results" / "views"
    names = {path.relative_to(views).as_posix() for path in views.rglob("*.png")}
    assert names == {f"{light}/view_00{k}.png" for light in ("day", "dim") for k in (0, 4)}
    bright, dark = (read_image(views / light / "view_000.png").mean() for light in ("day", "dim"))
    assert bright > 1.5 * dark > 0

    with pytest.raises(ValidationError):
        kind.resolve({"environments": []})
