"""Cameras that look all around."""

import numpy as np
import pytest

from octasplat.engine.dataset import Camera, PosedView, Viewpoints
from octasplat.engine.dataset.view_frusta import is_in_image
from octasplat.engine.surface.depth_cameras import photograph_cameras

PANORAMA = Camera("EQUIRECTANGULAR", (400.0, 200.0), 400, 200)
FISHEYE = Camera("OPENCV_FISHEYE", (150.0, 150.0, 200.0, 150.0, 0.0, 0.0, 0.0, 0.0), 400, 300)


def directions(count: int) -> np.ndarray:
    return np.random.default_rng(3).standard_normal((count, 3))


def test_panorama_rays_cover_sphere() -> None:
    assert is_in_image(directions(2000), PANORAMA).all()
    assert is_in_image(directions(2000), PANORAMA.scaled_to(100, 50)).all()
    assert is_in_image(np.vstack([np.eye(3), -np.eye(3)]), PANORAMA).all()


@pytest.mark.parametrize("camera", [FISHEYE, Camera("PINHOLE", (300.0, 300.0, 200.0, 150.0), 400, 300)])
def test_perspective_camera_ignores_points_behind(camera: Camera) -> None:
    way = directions(2000)
    assert not is_in_image(way, camera)[way[:, 2] <= 0].any()


def test_surface_cameras_cover_panorama() -> None:
    turn = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    view = PosedView(
        name="a.jpg",
        camera_index=0,
        width_px=400,
        height_px=200,
        rotation_cam_from_world=turn,
        translation_cam_from_world=-turn @ np.array([1.0, 2.0, 3.0]),
    )
    scene = Viewpoints(cameras=(PANORAMA,), views=(view,))
    cameras = photograph_cameras(scene, np.array([0]), 64, near_world=0.1)
    assert len(cameras) == 6
    points = np.array([1.0, 2.0, 3.0]) + 5 * directions(1000)
    seen = np.zeros(1000, int)
    for camera in cameras:
        np.testing.assert_allclose(camera.centre_world, [1, 2, 3], atol=1e-9)
        np.testing.assert_allclose(np.linalg.det(camera.rotation_cam_from_world), 1.0)
        xy = camera.project(points)
        seen += np.nan_to_num(((xy >= 0) & (xy <= 64)).all(axis=1)).astype(int)
    assert (seen == 1).all()
    np.testing.assert_allclose(cameras[0].rotation_cam_from_world, turn)
