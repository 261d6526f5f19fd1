"""Surfaces are taken back to the sparse points: along normals, by a share of the distance."""

import numpy as np
from jaxtyping import Float64

from engine.gaussians.frames import frames_from_normals, quaternions
from engine.gaussians.model import FlatGaussians
from engine.train.holding import Held

DOWN = np.array([0, 0, -0.01])


def _surface(
    means: Float64[np.ndarray, "n 3"], normals: Float64[np.ndarray, "n 3"], opacity: float = 0.9
) -> FlatGaussians:
    count = len(means)
    return FlatGaussians(
        means_world=means.astype(np.float32),
        quats_wxyz=quaternions(frames_from_normals(normals)).astype(np.float32),
        log_scales=np.full((count, 2), -3, np.float32),
        opacity_logits=np.full(count, np.log(opacity / (1 - opacity)), np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
    )


def _on_sphere(count: int, turn: float) -> Float64[np.ndarray, "n 3"]:
    z = 1 - 2 * (np.arange(count) + 0.5) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count) + turn
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], axis=1)


def _on_plane(side: int) -> Float64[np.ndarray, "n 3"]:
    x, y = np.meshgrid(np.linspace(-1, 1, side), np.linspace(-1, 1, side))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)


def test_a_sunk_plane_rises_by_the_share_and_only_along_its_normal() -> None:
    sunk = _on_plane(40) + np.array([0, 0, -0.05])
    gaussians = _surface(sunk, np.tile([0.0, 0.0, 1.0], (len(sunk), 1)))
    Held(_on_plane(30)).hold(gaussians, 0.25)
    np.testing.assert_allclose(gaussians.means_world[:, 2], -0.0375, atol=1e-6)
    np.testing.assert_allclose(gaussians.means_world[:, :2], sunk[:, :2], atol=1e-6)


def test_a_sphere_stays_where_it_is_and_a_shrunken_one_grows() -> None:
    points, places = _on_sphere(2000, 0.0), _on_sphere(3000, 1.0)
    right = _surface(places, places)
    held = Held(points)
    held.hold(right, 1.0)
    # Between the points a chord would lie 0.002 too deep.
    np.testing.assert_allclose(np.linalg.norm(right.means_world, axis=1), 1.0, atol=4e-4)
    shrunken = _surface(0.96 * places, places)
    held.hold(shrunken, 1.0)
    np.testing.assert_allclose(np.linalg.norm(shrunken.means_world, axis=1), 1.0, atol=1e-3)


def test_a_wall_is_not_pulled_by_the_floor_and_what_is_far_or_thin_stays() -> None:
    wall = _on_plane(40)[:, [2, 0, 1]] + np.array([0, 0, 1.0])  # x = 0, z from 0 to 2
    floor = _on_plane(40) + np.array([1.02, 0, 0])  # z = 0, x from 0.02
    means = np.concatenate([wall, floor + DOWN])
    normals = np.repeat([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], 1600, axis=0)
    gaussians = _surface(means, normals)
    Held(floor).hold(gaussians, 1.0)
    assert np.array_equal(gaussians.means_world[:1600], wall.astype(np.float32))
    np.testing.assert_allclose(gaussians.means_world[1600:, 2], 0.0, atol=1e-6)

    for far_or_thin in (
        _surface(floor + 50 * DOWN, normals[1600:]),
        _surface(floor + DOWN, normals[1600:], opacity=0.05),
    ):
        before = far_or_thin.means_world.copy()
        Held(floor).hold(far_or_thin, 1.0)
        assert np.array_equal(far_or_thin.means_world, before)
