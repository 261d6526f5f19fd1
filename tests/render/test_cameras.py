from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.render.pinhole_camera import PinholeCamera, focal_from_fov


def camera(**changes):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [20, -50, 130], degrees=True).as_matrix()
    pose[:3, 3] = [1, -2, 3]
    return PinholeCamera.from_pose(pose, **({"width_px": 8, "height_px": 6, "fy_px": 9.0} | changes))


def test_ray_projects_to_pixel_centre():
    one = camera(fx_px=7.0, cx_px=3.2, cy_px=2.9)
    origin, directions = one.rays().origin_world, one.rays().directions_world
    assert directions.shape == (6, 8, 3)
    assert np.linalg.norm(directions, axis=-1) == pytest.approx(1, abs=1e-6)
    points = origin + directions.reshape(-1, 3) * 4.5
    y, x = np.mgrid[0:6, 0:8] + 0.5
    assert np.allclose(one.project(points), np.stack([x.ravel(), y.ravel()], axis=-1), atol=1e-4)


def test_identity_camera_looks_along_z_with_y_down():
    one = PinholeCamera.from_pose(np.eye(4), 2, 2, fy_px=1.0)
    directions = one.rays().directions_world
    assert np.allclose(directions[0, 1] * np.sqrt(1.5), [0.5, -0.5, 1])
    assert np.allclose(one.project(np.array([[0.0, 0, 1]])), [[1, 1]])
    assert np.isnan(one.project(np.array([[0.0, 0, -1]]))).all()


def test_camera_pose_round_trip():
    one = camera()
    again = PinholeCamera.from_pose(one.world_from_cam, 8, 6, fy_px=9.0)
    assert np.allclose(one.centre_world, [1, -2, 3])
    assert np.allclose(again.rotation_cam_from_world, one.rotation_cam_from_world)
    assert np.allclose(again.translation_cam_from_world, one.translation_cam_from_world)
    assert (one.fx_px, one.cx_px, one.cy_px) == (9.0, 4.0, 3.0)


def test_field_of_view_spans_image():
    assert focal_from_fov(90.0, 200) == pytest.approx(100)
    assert focal_from_fov(60.0, 200) == pytest.approx(100 * np.sqrt(3))


def test_what_is_no_pose_is_refused():
    one = camera()
    near = PinholeCamera.from_pose(one.world_from_cam[:3].astype(np.float32).tolist(), 8, 6, fy_px=9.0)
    assert np.allclose(near.centre_world, one.centre_world, atol=1e-6)
    mirrored, infinite = np.diag([1.0, 1, -1, 1]), np.eye(4)
    infinite[0, 3] = np.inf
    for pose in (np.eye(3), "here", 2 * np.eye(4), mirrored, infinite):
        with pytest.raises(ConfigError, match=r"^world_from_cam: must "):
            PinholeCamera.from_pose(pose, 8, 6, fy_px=9.0)
    with pytest.raises(ConfigError, match="at least 1"):
        camera(width_px=0)
    with pytest.raises(ConfigError, match="focal length"):
        camera(fy_px=-9.0)
    with pytest.raises(ConfigError, match="three finite numbers"):
        PinholeCamera.looking_at((0, 0), (0, 0, 1))


def test_cameras_of_the_same_values_are_equal():
    one, again = camera(), camera()
    assert one == again and hash(one) == hash(again) and len({one, again}) == 1
    assert one != camera(fy_px=10.0) and one != camera(width_px=9) and one != "camera"
    pose = one.world_from_cam
    pose[0, 3] += 1e-9
    assert one != PinholeCamera.from_pose(pose, 8, 6, fy_px=9.0)
    zero, minus = np.zeros(3), -np.zeros(3)
    zeros = [replace(one, translation_cam_from_world=place) for place in (zero, minus)]
    assert zeros[0] == zeros[1] and hash(zeros[0]) == hash(zeros[1])
