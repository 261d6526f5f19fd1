"""Photographs that a command names: those of the run have its poses, others those of their own model."""

import json
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image, ImageOps

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset import load_dataset_model
from octasplat.engine.dataset.views_file import read_views, write_views
from octasplat.engine.runs.run_folder import has_photographs_of_run, run_viewpoints


@pytest.fixture
def posed_run(run, tmp_path) -> Path:
    """The run of the other tests as if octasplat had found the poses of its photographs."""
    output = shutil.copytree(run.output, tmp_path / "run", ignore=shutil.ignore_patterns("on", "cache"))
    shutil.copytree(run.scene / "images", tmp_path / "bare" / "images")
    shutil.copytree(run.scene / "sparse" / "0", output / "poses")
    content = json.loads((output / "config.json").read_text())
    content["scene"] = str((tmp_path / "bare").resolve())
    (output / "config.json").write_text(json.dumps(content))
    return output


@pytest.fixture
def others(run, tmp_path) -> Path:
    """Other photographs of the same names, which stand aside of those of the run."""
    folder = tmp_path / "others"
    for name in ("images", "sparse"):
        shutil.copytree(run.scene / name, folder / name)
    for path in (folder / "images").iterdir():
        ImageOps.invert(Image.open(path).convert("RGB")).save(path)
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), [0.1, 0.0, 0.0]))
    model.write(folder / "sparse" / "0")
    return folder


def test_evaluate_all_views_of_run_with_found_poses(posed_run, octasplat):
    done = octasplat("evaluate", posed_run, "--all-views", "--threads", 1)
    assert done.exit_code == 0, done.output
    assert_all_views_are_measured_alike(posed_run)


def test_evaluate_all_views_of_run_with_exposures(posed_run, octasplat):
    before = json.loads((posed_run / "metrics.json").read_text())["views"]
    training = json.loads((posed_run / "training.json").read_text())
    names = [path.name for path in (posed_run.parent / "bare" / "images").iterdir()]
    training["exposures"] = {name: {"log_gains": [-1.0] * 3, "offsets": [0.0] * 3} for name in names}
    (posed_run / "training.json").write_text(json.dumps(training))
    for options in ((), ("--all-views",)):
        done = octasplat("evaluate", posed_run, *options, "--threads", 1)
        assert done.exit_code == 0, done.output
    found = assert_all_views_are_measured_alike(posed_run)
    assert all(abs(found[name]["psnr"] - measured["psnr"]) > 0.1 for name, measured in before.items())


def assert_all_views_are_measured_alike(run: Path) -> dict[str, dict[str, float]]:
    """Check that all views were measured, those held out as in the run's own metrics; return the views."""
    metrics = json.loads((run / "on" / "bare" / "metrics.json").read_text())
    held_out = json.loads((run / "metrics.json").read_text())["views"]
    assert len(metrics["views"]) == 8 and len(held_out) == 2
    for name, measured in held_out.items():
        assert metrics["views"][name]["psnr"] == pytest.approx(measured["psnr"])
    return metrics["views"]


def test_evaluate_other_photographs_without_model_is_refused(posed_run, others, octasplat):
    shutil.rmtree(others / "sparse")
    refused = octasplat("evaluate", posed_run, "--other-dataset", others, "--threads", 1)
    assert refused.exit_code == 1 and "holds no COLMAP model" in refused.stderr


def test_cameras_of_other_photographs_are_those_of_their_model(posed_run, others):
    assert has_photographs_of_run(posed_run, posed_run.parent / "bare")
    assert not has_photographs_of_run(posed_run, others)
    expected = {view.name: view.origin_world for view in load_dataset_model(others).views}
    found = run_viewpoints(posed_run, scene=others)
    assert len(found.views) == 8
    for view in found.views:
        np.testing.assert_allclose(view.origin_world, expected[view.name])


def test_photographs_of_run_elsewhere_have_its_poses(posed_run, run):
    assert has_photographs_of_run(posed_run, run.scene)
    kept = run_viewpoints(posed_run)
    moved = run_viewpoints(posed_run, scene=run.scene)
    for mine, theirs in zip(kept.views, moved.views, strict=True):
        np.testing.assert_allclose(mine.origin_world, theirs.origin_world)


def test_photographs_of_run_in_their_world_before_a_transform_are_refused(posed_run, others, run):
    shutil.rmtree(posed_run / "poses")
    views = read_views(posed_run / "views.json")
    write_views(posed_run / "views.json", views.transformed(1.0, np.eye(3), np.array([0.0, 0.0, 9.0])))
    with pytest.raises(DatasetError, match=r"have other poses than the scene of .* was made or moved with"):
        run_viewpoints(posed_run, scene=run.scene)
    assert len(run_viewpoints(posed_run, scene=others).views) == 8  # which may stand where they like
