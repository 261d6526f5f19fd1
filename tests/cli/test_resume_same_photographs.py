"""``--resume`` goes on with the photographs and the model that a run was made from, wherever they lie."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from octasplat.engine.render.image_files import read_image, write_png


def content(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Every file with its time and bytes."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): (path.stat().st_mtime_ns, path.read_bytes()) for path in files}


def another_resolution(scene: Path) -> None:
    for path in (scene / "images").iterdir():
        write_png(path, np.repeat(np.repeat(read_image(path), 2, axis=0), 2, axis=1))


def another_picture(scene: Path) -> None:
    """Of the same size, and with the same time."""
    path = scene / "images/view_003.png"
    stat = path.stat()
    write_png(path, 1 - read_image(path))
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))


def a_mask(scene: Path) -> None:
    write_png(scene / "masks/view_002.png.png", np.ones((48, 64, 3), np.float32))


def changed_model(change: Callable[[pycolmap.Reconstruction], None]) -> Callable[[Path], None]:
    def apply(scene: Path) -> None:
        model = pycolmap.Reconstruction(str(scene / "sparse/0"))
        change(model)
        model.write_binary(str(scene / "sparse/0"))

    return apply


def turned_camera(model: pycolmap.Reconstruction) -> None:
    """About its own centre, which stays."""
    frame = model.find_image_with_name("view_006.png").frame
    turn = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0.0, 0.0, 0.1])), np.zeros(3))
    frame.rig_from_world = turn * frame.rig_from_world


def longer_lens(model: pycolmap.Reconstruction) -> None:
    camera = model.cameras[1]
    camera.params = [1.1 * camera.params[0], 1.1 * camera.params[1], *camera.params[2:]]


def fewer_points(model: pycolmap.Reconstruction) -> None:
    model.delete_point3D(next(iter(model.points3D)))


@pytest.mark.parametrize("finished", [False, True], ids=["stopped", "finished"])
@pytest.mark.parametrize(
    ("change", "told"),
    [
        (another_resolution, "view_000.png, view_001.png, view_002.png and 5 more with another file"),
        (another_picture, "view_003.png with another file"),
        (a_mask, "view_002.png with another mask"),
        (changed_model(turned_camera), "view_006.png with another pose"),
        (changed_model(longer_lens), "and 5 more with another camera"),
        (changed_model(fewer_points), "other sparse points"),
    ],
)
def test_resume_with_other_photographs_is_refused(run, octasplat, tmp_path, change, told, finished):
    output, others = tmp_path / "run", tmp_path / "others"
    shutil.copytree(run.output, output)
    if not finished:
        for name in (
            "scene.ply",
            "metrics.json",
            "report.html",
            "octagons.ply",
            "octagons.obj",
            "octagons.glb",
        ):
            (output / name).unlink()
    shutil.copytree(run.scene, others)
    change(others)
    before = content(output)
    result = octasplat("reconstruct", others, "-o", output, "--resume", "--threads", 1)
    assert result.exit_code == 1
    assert told in result.stderr and str(others) in result.stderr and result.stderr.count("\n") == 1
    assert content(output) == before


def test_resume_with_photographs_changed_in_place_is_refused(run, octasplat, tmp_path):
    output, scene = tmp_path / "run", tmp_path / "scene"
    shutil.copytree(run.scene, scene)
    shutil.copytree(run.output, output)
    assert octasplat("reconstruct", scene, "-o", output, "--resume", "--threads", 1).exit_code == 0
    write_png(scene / "images/view_003.png", 1 - read_image(scene / "images/view_003.png"))
    before = content(output)
    result = octasplat("reconstruct", scene, "-o", output, "--resume", "--threads", 1)
    assert result.exit_code == 1
    assert "view_003.png with another file" in result.stderr
    assert content(output) == before


def test_photographs_may_move_and_are_not_decoded_again(run, octasplat, tmp_path):
    output, moved = tmp_path / "run", tmp_path / "moved"
    shutil.copytree(run.output, output)
    for name in ("scene.ply", "octagons.ply", "octagons.obj", "octagons.glb"):
        (output / name).unlink()
    shutil.copytree(run.scene, moved)
    for path in (moved / "images").iterdir():
        os.utime(path)
    decoded = (output / "cache/rgb.bin").stat().st_ino
    result = octasplat("reconstruct", moved, "-o", output, "--resume", "--threads", 1)
    assert result.exit_code == 0, result.output
    assert (output / "cache/rgb.bin").stat().st_ino == decoded
    assert json.loads((output / "config.json").read_text())["scene"] == str(moved)
    for name in ("scene.ply", "octagons.ply", "octagons.obj", "octagons.glb", "views.json"):
        assert (output / name).read_bytes() == (run.output / name).read_bytes(), name
