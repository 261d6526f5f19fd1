import json

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.render.path_file import read_camera_path
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.pose_paths import turntable
from tests.support.camera_paths import path_from_poses, write_camera_path


@pytest.fixture
def path(tmp_path):
    return tmp_path / "path.json"


def content(**frame):
    pose = np.eye(4)
    pose[0, 3] = 2.0
    first = {"camera_to_world": pose.tolist(), "fov_y_degrees": 90}
    return {"width": 40, "height": 30, "frames": [first, first | frame]}


def test_path_file_round_trip(path):
    poses = turntable(np.zeros(3), np.array([0.0, -1, 0]), 2.0, 0.5, 5)
    like = PinholeCamera.from_pose(np.eye(4), 64, 48, fy_px=50.0, fx_px=51.0, cx_px=30.0, cy_px=25.0)
    written = path_from_poses(list(poses), like, 24.0)
    write_camera_path(path, written)
    again = read_camera_path(path)
    assert again.fps == 24
    for one, other in zip(again.cameras, written.cameras, strict=True):
        assert np.allclose(one.world_from_cam, other.world_from_cam)
        assert (one.width_px, one.height_px, one.fx_px, one.fy_px) == (64, 48, 51.0, 50.0)
        assert (one.cx_px, one.cy_px) == (30.0, 25.0)


def test_path_accepts_field_of_view_or_focal_lengths(path):
    path.write_text(json.dumps(content(fov_y_degrees=None, fx=11, fy=12)))
    first, second = read_camera_path(path).cameras
    assert (first.fx_px, first.fy_px, first.cx_px, first.cy_px) == pytest.approx((15, 15, 20, 15))
    assert (second.fx_px, second.fy_px) == (11, 12)
    assert np.allclose(first.centre_world, [2, 0, 0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fov_y_degrees": 200}, r"frames\[1\]\.fov_y_degrees"),
        ({"fov_y_degrees": None}, r"frames\[1\]: needs either fov_y_degrees or both"),
        ({"fx": 10, "fy": 10}, r"frames\[1\]: needs either"),
        ({"fov_y_degrees": None, "fy": 10}, r"frames\[1\]: needs either"),
        ({"fov": 3}, r"frames\[1\]\.fov"),
        ({"camera_to_world": [[1, 0, 0, 0]] * 3}, r"frames\[1\]\.camera_to_world"),
        ({"camera_to_world": (2 * np.eye(4)).tolist()}, r"frames\[1\]: camera_to_world must be a rotation"),
        ({"camera_to_world": np.diag([1, 1, -1, 1]).tolist()}, r"mirroring"),
        (
            {"camera_to_world": [[1, 0, 0, "x"], *np.eye(4).tolist()[1:]]},
            r"frames\[1\]\.camera_to_world\[0\]\[3\]",
        ),
    ],
)
def test_camera_path_error_names_file_and_field(path, change, message):
    path.write_text(json.dumps(content(**change)))
    with pytest.raises(ConfigError, match=rf"path\.json.*{message}"):
        read_camera_path(path)


def test_missing_or_invalid_path_file_is_refused(path):
    with pytest.raises(ConfigError, match=r"path\.json"):
        read_camera_path(path)
    path.write_text("{")
    with pytest.raises(ConfigError, match=r"path\.json"):
        read_camera_path(path)
    path.write_text(json.dumps({"width": 4, "height": 3, "frames": []}))
    with pytest.raises(ConfigError, match="frames"):
        read_camera_path(path)


def keys(**more):
    poses = [np.eye(4), np.eye(4), np.eye(4)]
    for number, pose in enumerate(poses):
        pose[0, 3] = 2.0 * number
    keys = [{"camera_to_world": pose.tolist(), "fov_y_degrees": 90} for pose in poses]
    return {"width": 40, "height": 30, "fps": 10, "seconds": 2, "keys": keys} | more


def test_keys_are_joined_smoothly(path):
    path.write_text(json.dumps(keys()))
    cameras = read_camera_path(path).cameras
    places = np.array([camera.centre_world for camera in cameras])
    assert len(cameras) == 20
    # Keys in a line and equally far apart are passed at one pace.
    np.testing.assert_allclose(places, np.linspace([0, 0, 0], [4, 0, 0], 20), atol=1e-6)
    path.write_text(json.dumps(keys(ease="in-out")))
    eased = np.array([camera.centre_world[0] for camera in read_camera_path(path).cameras])
    time = np.linspace(0, 1, 20)
    np.testing.assert_allclose(eased, 4 * time**2 * (3 - 2 * time), atol=1e-6)


def test_lenses_change_between_keys_and_a_closed_path_comes_back(path):
    text = keys()
    text["keys"][1] = {**text["keys"][1], "fov_y_degrees": None, "fx": 30, "fy": 30}
    path.write_text(json.dumps(text | {"seconds": 2.1}))
    focal = [camera.fy_px for camera in read_camera_path(path).cameras]
    assert (focal[0], focal[10], focal[20]) == pytest.approx((15, 30, 15))
    text["keys"][2]["camera_to_world"][1][3] = 3.0
    path.write_text(json.dumps(text | {"closed": True}))
    places = np.array([camera.centre_world for camera in read_camera_path(path).cameras])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert np.linalg.norm(places[0] - places[-1]) < 2 * steps.max()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seconds": None}, "keys need seconds"),
        ({"frames": content()["frames"]}, "either frames or keys"),
        ({"keys": None, "frames": content()["frames"]}, "frames have none"),
        ({"seconds": 1e9}, "more than 100,000 frames"),
        ({"closed": True, "ease": "in-out"}, "leave out ease"),
        ({"keys": keys()["keys"][:2], "closed": True}, "at least 3 poses"),
    ],
)
def test_invalid_path_keys_are_refused(path, change, message):
    path.write_text(json.dumps(keys(**change)))
    with pytest.raises(ConfigError, match=message) as error:
        read_camera_path(path)
    assert str(path) in str(error.value)
