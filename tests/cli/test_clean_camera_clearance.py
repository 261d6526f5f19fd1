"""``octasplat clean`` of a run takes away what stands right before a camera, or in too few views."""

import shutil

import numpy as np

from octasplat.engine.dataset.view_frusta import ViewFrusta, cam_from_world, is_in_image
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


def test_clean_removes_gaussians_beyond_what_cameras_see(run, octasplat, tmp_path):
    shutil.copytree(run.output, tmp_path / "run", ignore=shutil.ignore_patterns("cache"))
    scene, _ = read_gaussian_ply(run.output / "scene.ply")
    views = read_views(run.output / "views.json").viewpoints(None)
    above = scene.select(np.arange(7))
    centre = np.mean([views.views[i].origin_world for i in views.train_indices], axis=0)
    ups = np.mean([views.views[i].rotation_cam_from_world[1] for i in views.train_indices], axis=0)
    above.means_world = (centre - 100 * ups + np.arange(7)[:, None] * 0.01).astype(np.float32)
    frusta = ViewFrusta.from_views(views, views.train_indices)
    seen = sum(
        is_in_image(
            cam_from_world(scene.means_world.astype(np.float64), view), views.cameras[view.camera_index]
        )
        for view in frusta.views
    )
    write_gaussian_ply(concatenate([scene, above]), tmp_path / "run" / "scene.ply")
    only_seen = ("--no-floaters", "--min-opacity", 0, "--camera-clearance", 0)
    for min_views in (1, 3):
        wanted = 7 + int((seen < min_views).sum())
        result = octasplat("clean", tmp_path / "run", "--dry-run", *only_seen, "--min-views", min_views)
        assert f" {wanted} beyond what the cameras see" in result.output
    result = octasplat("clean", tmp_path / "run", "--dry-run", *only_seen)
    assert " 0 beyond what the cameras see" in result.output
    result = octasplat("clean", tmp_path / "run" / "scene.ply", "--dry-run", *only_seen, "--min-views", 3)
    assert "min_views goes with the folder of a run" in result.output
