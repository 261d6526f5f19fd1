"""Photographs and models that nothing good can come of: refused, or told of, by the command line."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest

ONE_STEP = ("--iterations", 1, "--quiet")


@pytest.fixture
def edited(scene: Path, tmp_path: Path) -> Callable[..., Path]:
    """A copy of the scene whose model was changed, written as text or binary."""

    def edit(change: Callable[[pycolmap.Reconstruction], None], text: bool = False) -> Path:
        copy = tmp_path / "scene"
        shutil.copytree(scene, copy)
        model = pycolmap.Reconstruction(str(copy / "sparse/0"))
        change(model)
        shutil.rmtree(copy / "sparse/0")
        (copy / "sparse/0").mkdir()
        (model.write_text if text else model.write_binary)(str(copy / "sparse/0"))
        return copy

    return edit


def place(model: pycolmap.Reconstruction, name: str, centre_world: np.ndarray) -> None:
    """Move a camera without turning it."""
    image = model.find_image_with_name(name)
    rotation = image.cam_from_world().rotation
    image.frame.rig_from_world = pycolmap.Rigid3d(rotation, -(rotation.matrix() @ centre_world))


@pytest.mark.parametrize(
    ("file", "first", "field", "whose"),
    [
        ("images.txt", 2, 5, r"the pose of view_001\.png"),
        ("frames.txt", 2, 8, r"the pose of view_002\.png"),
        ("cameras.txt", 0, 4, "camera 1"),
        ("points3D.txt", 3, 2, "point 4"),
    ],
)
def test_text_model_with_nan_is_refused(edited, octasplat, tmp_path, file, first, field, whose):
    copy = edited(lambda _model: None, text=True)
    path = copy / "sparse/0" / file
    lines = path.read_text().splitlines()
    number = [index for index, line in enumerate(lines) if not line.startswith("#")][first]
    words = lines[number].split()
    words[field] = "nan"
    lines[number] = " ".join(words)
    path.write_text("\n".join(lines) + "\n")
    result = octasplat("reconstruct", copy, "-o", tmp_path / "run", *ONE_STEP)
    assert result.exit_code == 1
    assert str(path) in result.stderr and f"(line {number + 1})" in result.stderr
    assert "Check failed" not in result.stderr
    assert re.search(rf"'nan' where a finite number belongs in {whose} ", result.stderr)


def test_camera_with_huge_position_is_refused(edited, octasplat, tmp_path):
    copy = edited(lambda model: place(model, "view_003.png", np.array([1e12, 0.0, 0.0])))
    result = octasplat("reconstruct", copy, "-o", tmp_path / "run", *ONE_STEP)
    assert result.exit_code == 1
    assert "view_003.png" in result.stderr and "times as far" in result.stderr
    assert str(copy / "sparse/0") in result.stderr


def test_distant_camera_warns(edited, octasplat, tmp_path, tiny):
    copy = edited(lambda model: place(model, "view_003.png", np.array([200.0, 0.0, 0.0])))
    result = octasplat("reconstruct", copy, "-o", tmp_path / "run", *tiny, *ONE_STEP)
    assert result.exit_code == 0, result.output
    assert result.stderr.count("Warning:") == 1
    assert "view_003.png" in result.stderr and "times as far" in result.stderr


def test_identical_poses_are_refused(edited, octasplat, tmp_path):
    def gather(model: pycolmap.Reconstruction) -> None:
        for frame in model.frames.values():
            frame.rig_from_world = model.frames[1].rig_from_world

    result = octasplat("reconstruct", edited(gather), "-o", tmp_path / "run", *ONE_STEP)
    assert result.exit_code == 1
    assert "All 8 images" in result.stderr and "one and the same pose" in result.stderr
    assert "view_000.png" in result.stderr


def test_duplicate_poses_warn(edited, octasplat, tmp_path, tiny):
    def double(model: pycolmap.Reconstruction) -> None:
        pose = model.find_image_with_name("view_005.png").cam_from_world()
        model.find_image_with_name("view_002.png").frame.rig_from_world = pose

    result = octasplat("reconstruct", edited(double), "-o", tmp_path / "run", *tiny, *ONE_STEP)
    assert result.exit_code == 0, result.output
    assert "2 images" in result.stderr and "view_002.png = view_005.png" in result.stderr


@pytest.mark.parametrize("shiny", [(), ("--materials",)])
def test_masks_as_alpha_need_masks(scene, octasplat, tmp_path, shiny):
    result = octasplat("reconstruct", scene, "-o", tmp_path / "run", "--masks", "alpha", *ONE_STEP, *shiny)
    assert result.exit_code == 1
    assert str(scene / "masks") in result.stderr and "--masks alpha" in result.stderr
    assert not (tmp_path / "run" / "config.json").exists()
