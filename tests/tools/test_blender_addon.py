"""The add-on for Blender, installed from its ZIP file and used as by a person."""

import json
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.files import export_scene, read_scene
from octasplat.engine.gaussians.rows import row_arrays
from octasplat.engine.render.path_file import read_camera_path
from tests.support.blender_python import SCRIPTS, run_blender
from tests.support.shell_scene import shell_scene

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "blender"
PROGRAM = Path(sys.executable).with_name("octasplat")
CAMERA = {"model": "SIMPLE_RADIAL", "params": [90.0, 60.0, 45.0, 0.01], "width_px": 120, "height_px": 90}
TURNED = [[0.6, 0.0, -0.8], [0.0, 1.0, 0.0], [0.8, 0.0, 0.6]]


def packed(folder: Path) -> Path:
    target = folder / "octasplat_blender.zip"
    subprocess.run([sys.executable, EXAMPLES / "pack_addon.py", target], check=True)
    return target


def test_addon_is_one_file_with_licence(tmp_path: Path) -> None:
    with zipfile.ZipFile(packed(tmp_path)) as archive:
        assert set(archive.namelist()) >= {"blender_manifest.toml", "__init__.py"}
        manifest = archive.read("blender_manifest.toml").decode()
    assert 'license = ["SPDX:Apache-2.0"]' in manifest and 'blender_version_min = "4.2.0"' in manifest


@pytest.mark.exhaustive
@pytest.mark.tools
@pytest.mark.heavy
def test_addon_opens_edits_and_saves_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("BLENDER_USER_RESOURCES", str(tmp_path / "blender"))
    scene = shell_scene(200)
    export_scene(scene, tmp_path / "scene.ply")
    view = {"camera": 0, "width_px": 120, "height_px": 90, "translation_cam_from_world": [0.1, 0.2, 3.0]}
    views = [
        {**view, "name": name, "rotation_cam_from_world": turn}
        for name, turn in (("a.jpg", np.eye(3).tolist()), ("b.jpg", TURNED))
    ]
    (tmp_path / "views.json").write_text(json.dumps({"cameras": [CAMERA], "views": views}))

    told = run_blender(SCRIPTS / "use_addon.py", packed(tmp_path), PROGRAM, tmp_path / "scene.ply", tmp_path)

    assert "CAMERAS 2 ['a.jpg', 'b.jpg']" in told
    path = read_camera_path(tmp_path / "path.json")
    for camera, expected in zip(path.cameras, views, strict=True):
        np.testing.assert_allclose(
            camera.rotation_cam_from_world, expected["rotation_cam_from_world"], atol=1e-5
        )
        np.testing.assert_allclose(camera.translation_cam_from_world, [0.1, 0.2, 3.0], atol=1e-5)
        optics = [camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px]
        np.testing.assert_allclose(optics, [90, 90, 60, 45], rtol=1e-5)
    before, same, after = (
        row_arrays(read_scene(tmp_path / name)[0]) for name in ("scene.ply", "same.ply", "moved.ply")
    )
    corner_chosen, half, inside = (
        np.load(tmp_path / f"{name}.npy").reshape(-1, 8) for name in ("ANY", "HALF", "ALL")
    )
    for chosen in (corner_chosen, half, inside):
        assert (chosen == chosen[:, :1]).all()
    assert corner_chosen.sum() > half.sum() > inside.sum() > 0
    assert f"FACES ALL {inside[:, 0].sum() * 6}" in told
    for name, rows in before.items():
        assert same[name].tobytes() == rows.tobytes(), name
        kept = ~inside[:, 0]
        assert after[name][kept].tobytes() == rows[kept].tobytes(), name
    shift = after["means_world"] - before["means_world"]
    np.testing.assert_allclose(shift[inside[:, 0]], np.tile([0, 0, 2], (inside[:, 0].sum(), 1)), atol=1e-6)
    assert "There is no program 'nowhere/octasplat'" in told and "gone.ply" in told
    assert not (tmp_path / "never.ply").exists()
