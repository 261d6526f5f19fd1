import numpy as np
import pytest

from octasplat.engine.gaussians.frames import (
    frames_from_normals,
    quaternions_from_matrices,
    rotation_matrices,
)


def about(axis: list[float], degrees: float) -> np.ndarray:
    half = np.radians(degrees) / 2
    unit = np.array(axis) / np.linalg.norm(axis)
    return np.array([[np.cos(half), *(np.sin(half) * unit)]])


def test_quarter_turn_about_z_takes_x_to_y() -> None:
    rotation = rotation_matrices(about([0, 0, 1], 90))[0]
    np.testing.assert_allclose(rotation @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(rotation @ [0, 1, 0], [-1, 0, 0], atol=1e-15)


def test_length_and_sign_of_a_quaternion_do_not_matter() -> None:
    q = np.random.default_rng(0).normal(size=(50, 4))
    expected = rotation_matrices(q)
    np.testing.assert_allclose(rotation_matrices(q * 1e-20), expected, atol=1e-14)
    np.testing.assert_allclose(rotation_matrices(q * -1e20), expected, atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(expected), 1.0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 90.0, 179.0, 179.999999, 180.0, 180.000001])
@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, -2, 3], [1e-9, 1, -1e-9]])
def test_quaternions_come_back_at_every_angle(axis: list[float], angle: float) -> None:
    q = about(axis, angle)
    back = quaternions_from_matrices(rotation_matrices(q))
    assert back[0, 0] >= 0
    np.testing.assert_allclose(np.linalg.norm(back), 1.0, atol=1e-15)
    assert abs(float(np.sum(q * back))) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_allclose(rotation_matrices(back), rotation_matrices(q), atol=1e-14)


def test_many_float32_rotations_close_to_half_turns_stay_accurate() -> None:
    random = np.random.default_rng(1)
    q = random.normal(size=(2000, 4)).astype(np.float32)
    q[:, 0] *= 1e-4
    rotations = rotation_matrices(q)
    assert rotations.dtype == np.float32
    np.testing.assert_allclose(rotation_matrices(quaternions_from_matrices(rotations)), rotations, atol=1e-6)


def test_frames_from_normals_are_proper_and_begin_with_the_normal() -> None:
    n = np.concatenate([np.eye(3), -np.eye(3), np.random.default_rng(2).normal(size=(100, 3))])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    frames = frames_from_normals(n)
    np.testing.assert_array_equal(frames[:, :, 0], n)
    np.testing.assert_allclose(
        frames @ frames.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frames.shape), atol=1e-14
    )
    np.testing.assert_allclose(np.linalg.det(frames), 1.0)
