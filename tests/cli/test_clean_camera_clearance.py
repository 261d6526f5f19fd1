"""``octasplat clean`` of a run takes away what stands right before a camera."""

import shutil

import numpy as np

from octasplat.engine.dataset.views_file import read_views
from octasplat.engine.files.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from octasplat.engine.gaussians.model import concatenate
from octasplat.engine.runs.run_folder import run_camera_clearance


def test_clean_removes_gaussians_near_cameras(run, octasplat, tmp_path):
    shutil.copytree(run.output, tmp_path / "run", ignore=shutil.ignore_patterns("cache"))
    scene, _ = read_gaussian_ply(run.output / "scene.ply")
    zones = run_camera_clearance(run.output, 0.25)
    assert zones is not None and (zones.radii > 0).any()
    view = int(np.argmax(zones.radii))
    cloud = scene.select(np.arange(40))
    forward = zones.views[view].rotation_cam_from_world[2]
    spread = np.random.default_rng(0).normal(0, 0.01, (40, 3))
    place = zones.views[view].origin_world + 0.5 * zones.radii[view] * (forward + spread)
    cloud.means_world = place.astype(np.float32)
    near_before = int(zones.contains(scene.means_world).sum())
    write_gaussian_ply(concatenate([scene, cloud]), tmp_path / "run" / "scene.ply")

    only_near = ("--no-floaters", "--min-opacity", 0)
    result = octasplat("clean", tmp_path / "run", "-o", tmp_path / "clean.ply", *only_near)
    assert result.exit_code == 0, result.output
    assert f"{40 + near_before} too near to a camera" in result.output
    cleaned, _ = read_gaussian_ply(tmp_path / "clean.ply")
    assert len(cleaned) == len(scene) - near_before
    result = octasplat("clean", tmp_path / "run", "--dry-run", *only_near, "--camera-clearance", 0)
    assert " 0 too near to a camera" in result.output
    assert len(read_views(run.output / "views.json").views) == len(zones.views) + len(run.metrics()["views"])
