import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.pose_paths import PosePath, fit_turntable, interpolate, look_at, turntable

CENTRE, UP = np.array([1.0, -2.0, 0.5]), np.array([0.2, -3.0, 0.4])


def assert_rigid(poses):
    rotations = poses[:, :3, :3]
    assert np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=1e-9)
    assert np.allclose(np.linalg.det(rotations), 1)
    assert np.allclose(poses[:, 3], [0, 0, 0, 1])


def keys(count, seed=0):
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    angles = np.arange(count)[:, None] * [[11.0, 35.0, -20.0]]
    poses[:, :3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    poses[:, :3, 3] = rng.normal(size=(count, 3)) * [3, 1, 2]
    return poses


def test_turntable_looks_at_centre_from_constant_distance():
    poses = turntable(CENTRE, UP, 3.0, 1.5, 12)
    assert_rigid(poses)
    for pose in poses:
        camera = PinholeCamera.from_pose(pose, 40, 30, fy_px=35.0)
        assert np.allclose(camera.project(CENTRE[None]), [[20, 15]], atol=1e-6)
        above = camera.project((CENTRE + 0.1 * UP)[None])[0]
        assert above[0] == pytest.approx(20, abs=1e-6) and above[1] < 15
    offsets = poses[:, :3, 3] - CENTRE
    unit = UP / np.linalg.norm(UP)
    assert offsets @ unit == pytest.approx(1.5)
    assert np.linalg.norm(offsets, axis=-1) == pytest.approx(np.hypot(3.0, 1.5))


def test_turntable_turns_in_equal_steps():
    poses = turntable(np.zeros(3), np.array([0.0, 0, 1]), 2.0, 0.0, 4, start_world=np.array([0.0, 5, 9]))
    assert np.allclose(poses[:, :3, 3], [[0, 2, 0], [-2, 0, 0], [0, -2, 0], [2, 0, 0]], atol=1e-12)
    back = turntable(
        np.zeros(3), np.array([0.0, 0, 1]), 2.0, 0.0, 4, start_world=np.array([0.0, 5, 9]), turns=-1.0
    )
    assert np.allclose(back[1, :3, 3], [2, 0, 0], atol=1e-12)


@pytest.mark.parametrize("closed", [False, True])
def test_path_passes_through_key_poses(closed):
    path = PosePath(keys(5), closed)
    times = path.key_times
    assert times[0] == 0 and times[-1] == 1 and (np.diff(times) > 0).all()
    expected = keys(5) if not closed else np.concatenate([keys(5), keys(5)[:1]])
    assert np.allclose(path.poses_at(times), expected, atol=1e-9)
    assert_rigid(path.poses_at(np.linspace(0.0, 1.0, 50)))


@pytest.mark.parametrize("closed", [False, True])
def test_camera_path_velocity_is_continuous(closed):
    path = PosePath(keys(6), closed)
    step = 1e-6
    at = path.key_times[1:-1]
    before, here, after = path.poses_at(at - step), path.poses_at(at), path.poses_at(at + step)
    assert np.allclose(after - here, here - before, atol=1e-4 * step * 1e3)
    if closed:
        ends = path.poses_at(np.array([0.0, step, 1 - step, 1.0]))
        assert np.allclose(ends[1] - ends[0], ends[3] - ends[2], atol=1e-3 * step * 1e3)


def test_open_path_starts_and_ends_at_keys():
    poses = interpolate(keys(4), 20)
    assert poses.shape == (20, 4, 4)
    assert np.allclose(poses[[0, -1]], keys(4)[[0, -1]], atol=1e-9)


def test_camera_path_of_two_poses_is_linear():
    two = keys(2)
    middle = interpolate(two, 3)[1]
    assert np.allclose(middle[:3, 3], two[:, :3, 3].mean(axis=0))
    turn = Rotation.from_matrix(two[1, :3, :3]) * Rotation.from_matrix(two[0, :3, :3]).inv()
    half = Rotation.from_rotvec(turn.as_rotvec() / 2) * Rotation.from_matrix(two[0, :3, :3])
    assert np.allclose(middle[:3, :3], half.as_matrix(), atol=1e-9)


def test_closed_path_stays_near_turntable_circle():
    poses = interpolate(turntable(CENTRE, UP, 3.0, 1.0, 12), 60, closed=True)
    offsets = poses[:, :3, 3] - CENTRE
    assert np.linalg.norm(offsets, axis=-1) == pytest.approx(np.sqrt(10), rel=2e-3)
    towards = np.einsum(
        "nd,nd->n", poses[:, :3, 2], -offsets / np.linalg.norm(offsets, axis=-1, keepdims=True)
    )
    assert towards.min() > np.cos(np.radians(0.5))
    gaps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0, append=poses[:1, :3, 3]), axis=-1)
    assert gaps.max() < 1.05 * gaps.min()


def test_keys_in_one_place_only_turn_the_camera():
    poses = keys(3)
    poses[:, :3, 3] = [1, 2, 3]
    assert np.allclose(interpolate(poses, 9)[:, :3, 3], [1, 2, 3])
    mixed = keys(4)
    mixed[2, :3, 3] = mixed[1, :3, 3]
    assert np.isfinite(interpolate(mixed, 9)).all()


def test_fitting_gives_back_the_turntable_of_its_cameras():
    poses = turntable(CENTRE, UP, 3.0, 1.5, 9)
    fitted = fit_turntable(poses[:, :3, 3], poses[:, :3, 2], -poses[:, :3, 1])
    assert fitted.centre_world == pytest.approx(CENTRE)
    assert fitted.up_world == pytest.approx(UP / np.linalg.norm(UP))
    assert (fitted.radius, fitted.height) == pytest.approx((3.0, 1.5))
    assert np.allclose(fitted.poses(9), poses, atol=1e-6)


def test_outlier_cameras_do_not_move_centre():
    poses = turntable(CENTRE, UP, 3.0, 1.5, 20)
    unit = UP / np.linalg.norm(UP)
    for stray in (2, 7, 11):
        poses[stray] = look_at(poses[stray, :3, 3], CENTRE + 2 * poses[stray, :3, 0], unit)
    fitted = fit_turntable(poses[:, :3, 3], poses[:, :3, 2], -poses[:, :3, 1])
    assert fitted.centre_world == pytest.approx(CENTRE, abs=0.01)


def test_camera_path_invalid_keys_are_refused():
    flat = np.tile(np.array([0.0, 0, 1]), (4, 1))
    centres = np.random.default_rng(0).normal(size=(4, 3))
    with pytest.raises(ConfigError, match="same way"):
        fit_turntable(centres, flat, np.tile(np.array([0.0, -1, 0]), (4, 1)))
    with pytest.raises(ConfigError, match="up direction"):
        fit_turntable(centres, flat, np.array([[0.0, 1, 0], [0, -1, 0], [1, 0, 0], [-1, 0, 0]]))
    with pytest.raises(ConfigError, match="radius"):
        turntable(CENTRE, UP, 0.0, 1.0, 5)
    with pytest.raises(ConfigError, match="at least 2 poses"):
        interpolate(keys(1), 5)
    with pytest.raises(ConfigError, match="at least 3 poses"):
        interpolate(keys(2), 5, closed=True)
    with pytest.raises(ConfigError, match="two frames"):
        interpolate(keys(3), 1)
    with pytest.raises(ConfigError, match="up direction"):
        look_at(CENTRE + UP, CENTRE, UP)
