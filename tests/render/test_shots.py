"""Cameras for series of images, from photographs or from nothing but Gaussians."""

import math
from dataclasses import replace

import numpy as np
import pytest

from octasplat.engine.dataset import Dataset, load_dataset_model
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.shots import (
    camera_shots,
    fov_y_of_views,
    gaussian_turntable,
    turntable_cameras,
    turntable_of_views,
    view_shots,
)


@pytest.fixture(scope="module", params=["PINHOLE", "OPENCV_FISHEYE"])
def scene_folder(request, tmp_path_factory):
    root = tmp_path_factory.mktemp("jobs") / "scene"
    config = SyntheticDatasetConfig(
        views=6, width_px=32, height_px=24, samples_per_side=1, points=100, camera_model=request.param
    )
    write_synthetic_dataset(root, config)
    return root


def test_rays_of_views_are_those_of_training(scene_folder, tmp_path):
    scene = load_dataset_model(scene_folder)
    data = Dataset.open(scene_folder, tmp_path)
    shots = view_shots(scene, np.array([1, 4]))
    assert [shot.name for shot in shots] == ["view_001", "view_004"]
    for index, shot in zip((1, 4), shots, strict=True):
        made, expected = shot.rays(), data.view_rays(index)
        np.testing.assert_allclose(made.origin_world, expected.origin_world, atol=2e-4)
        # tables of rays are rounded
        np.testing.assert_allclose(made.directions_world, expected.directions_world, atol=2e-4)


def test_turntable_of_a_scene_goes_round_its_table(scene_folder):
    scene = load_dataset_model(scene_folder)
    table = turntable_of_views(scene, cloud(np.eye(3), np.zeros(3)))
    np.testing.assert_allclose(table.up_world, [0, 0, 1], atol=0.1)
    assert np.linalg.norm(table.centre_world) < table.radius / 2


def test_cameras_that_all_look_the_same_way_go_round_the_middle_of_the_scene(scene_folder):
    scene = load_dataset_model(scene_folder)
    forward = np.diag([1.0, -1.0, -1.0])  # they look along -z with y up
    views = tuple(
        replace(view, rotation_cam_from_world=forward, translation_cam_from_world=-forward @ [k, 2.0, 5.0])
        for k, view in enumerate(scene.views)
    )
    middle = np.array([3.0, 1.0, -4.0])
    gaussians = cloud(middle + np.random.default_rng(0).uniform(-1, 1, (500, 3)), np.full(500, 4.0))
    table = turntable_of_views(replace(scene, views=views), gaussians)
    np.testing.assert_allclose(table.centre_world, middle, atol=0.1)
    np.testing.assert_allclose(table.up_world, [0, 1, 0], atol=1e-9)
    assert table.radius > 8 and table.height == pytest.approx(1.0, abs=0.1)


def test_field_of_view_of_a_scene(scene_folder):
    scene = load_dataset_model(scene_folder)
    camera = scene.cameras[0]
    expected = math.degrees(2 * math.atan(camera.height_px / 2 / camera.params[1]))
    assert fov_y_of_views(scene) == pytest.approx(expected, rel=0.15)


def cloud(means, opacity_logits):
    count = len(means)
    return FlatGaussians(
        means_world=means.astype(np.float32),
        quats_wxyz=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.full((count, 2), -3, np.float32),
        opacity_logits=np.full(count, opacity_logits, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )


@pytest.mark.parametrize("up", [None, np.array([0.0, 0.0, 2.0])])
def test_turntable_of_gaussians_shows_all_of_them(up):
    middle = np.array([3.0, -2.0, 7.0])
    means = middle + np.random.default_rng(3).standard_normal((2000, 3))
    gaussians = cloud(means, 2.0)
    table = gaussian_turntable(gaussians, up_world=up, fov_y_degrees=40)
    np.testing.assert_allclose(table.centre_world, middle, atol=0.5)
    np.testing.assert_allclose(table.up_world, [0, -1, 0] if up is None else [0, 0, 1])
    assert table.height > 0
    for camera in turntable_cameras(table, 3, 64, 64, 40):
        pixels = camera.project(means)
        assert ((pixels > 0) & (pixels < 64)).all(axis=1).mean() > 0.99


@pytest.mark.parametrize("aspect", [0.5, 2.0])
def test_turntable_camera_fits_scene_of_any_aspect(aspect):
    # A pole and a plate, as far as a cylinder around them goes.
    rng = np.random.default_rng(5)
    for extent in ((0.3, 3.0, 0.3), (3.0, 0.3, 3.0)):
        around = rng.uniform(-1, 1, (4000, 3)) * extent
        strays = np.array([[40.0, 0, 0], [0, -90.0, 0]])
        gaussians = cloud(np.concatenate([around, strays]), 4.0)
        table = gaussian_turntable(gaussians, fov_y_degrees=40, aspect=aspect)
        reach = 0.0
        for camera in turntable_cameras(table, 8, int(64 * aspect), 64, 40):
            pixels = camera.project(around) / [64 * aspect, 64]
            assert ((pixels > 0) & (pixels < 1)).all(axis=1).mean() > 0.99
            reach = max(reach, np.abs(2 * pixels - 1).max())
        assert reach > 0.75, "the camera stands too far away"


def test_faint_gaussians_do_not_move_the_turntable():
    rng = np.random.default_rng(4)
    solid, haze = rng.standard_normal((300, 3)), 50 + rng.standard_normal((300, 3))
    gaussians = cloud(np.concatenate([solid, haze]), 3.0)
    gaussians.opacity_logits[300:] = -6
    assert np.linalg.norm(gaussian_turntable(gaussians).centre_world) < 1


def test_single_gaussian_has_turntable():
    table = gaussian_turntable(cloud(np.array([[1.0, 2.0, 3.0]]), 1.0))
    np.testing.assert_allclose(table.centre_world, [1, 2, 3])
    assert table.radius > 0


def test_camera_shots_frame_names():
    table = gaussian_turntable(cloud(np.eye(3), 1.0))
    shots = camera_shots(turntable_cameras(table, 2, 8, 6))
    assert [shot.name for shot in shots] == ["frame_0000", "frame_0001"]
    assert shots[0].rays().directions_world.shape == (6, 8, 3)
