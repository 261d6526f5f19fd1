from collections.abc import Callable

import numpy as np

from octasplat.engine.gaussians.frames import rotation_matrices
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.triangle import frames_from_triangles, triangles_world

Make = Callable[..., FlatGaussians]


def covariances(rotations: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    legs = rotations[:, :, 1:].astype(np.float64) * np.exp(log_scales.astype(np.float64))[:, None]
    return legs @ legs.transpose(0, 2, 1)


def test_triangle_of_an_axis_aligned_gaussian_puts_the_longer_leg_first() -> None:
    g = FlatGaussians(
        np.array([[1, 2, 3], [1, 2, 3]], np.float32),
        np.array([[1, 0, 0, 0], [1, 0, 0, 0]], np.float32),
        np.log(np.array([[2, 0.5], [0.5, 2]], np.float32)),
        np.zeros(2, np.float32),
        np.zeros((2, 1, 3), np.float32),
    )
    triangles = triangles_world(g)
    np.testing.assert_allclose(triangles[0], [[1, 2, 3], [1, 4, 3], [1, 2, 3.5]], rtol=1e-6)
    np.testing.assert_allclose(triangles[1], [[1, 2, 3], [1, 2, 5], [1, 1.5, 3]], rtol=1e-6)


def test_triangles_and_back_keep_covariance_normal_and_centre(make_gaussians: Make) -> None:
    g = make_gaussians(300)
    means, quats, log_scales, good = frames_from_triangles(triangles_world(g))
    assert good.all()
    np.testing.assert_array_equal(means, g.means_world)
    assert (log_scales[:, 0] >= log_scales[:, 1]).all()
    np.testing.assert_allclose(np.sort(log_scales, axis=1), np.sort(g.log_scales, axis=1), atol=1e-5)
    rotations = rotation_matrices(quats)
    np.testing.assert_allclose(rotations[:, :, 0], g.rotations[:, :, 0], atol=1e-5)
    expected = covariances(g.rotations, g.log_scales)
    error = np.linalg.norm(covariances(rotations, log_scales) - expected, axis=(1, 2))
    assert (error / np.linalg.norm(expected, axis=(1, 2))).max() < 1e-5


def test_sheared_triangle_keeps_its_first_leg_and_its_area() -> None:
    vertices = np.array([[[0, 0, 0], [3, 0, 0], [1, 2, 0]]], dtype=np.float64)
    _, quats, log_scales, good = frames_from_triangles(vertices)
    assert good.all()
    np.testing.assert_allclose(np.exp(log_scales), [[3, 2]])
    z, x, y = [0, 0, 1], [1, 0, 0], [0, 1, 0]
    np.testing.assert_allclose(rotation_matrices(quats)[0], np.stack([z, x, y], axis=1), atol=1e-15)


def test_triangles_without_area_are_found() -> None:
    vertices = np.random.default_rng(0).normal(size=(5, 3, 3)).astype(np.float32)
    vertices[0, 1] = vertices[0, 0]
    vertices[1, 2] = vertices[1, 0]
    vertices[2, 2] = vertices[2, 0] + 3 * (vertices[2, 1] - vertices[2, 0])
    vertices[3, 2, 1] = np.inf
    _, quats, log_scales, good = frames_from_triangles(vertices)
    np.testing.assert_array_equal(good, [False, False, False, False, True])
    np.testing.assert_array_equal(log_scales[:4], 0)
    np.testing.assert_array_equal(quats[:4], np.broadcast_to([1, 0, 0, 0], (4, 4)))
