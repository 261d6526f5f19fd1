"""Normals with a side, and blends of them that are made to face the viewer."""

import numpy as np
import pytest

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.frames import frames_from_normals, quaternions_from_matrices
from octasplat.engine.trace.facing_normals import MIN_VIEW_COSINE, face_viewer
from tests.support.trace_scenes import f32, facing_z, make_tracer, unit

pytestmark = pytest.mark.usefixtures("both_ways")


def wall_seen_at(cosines: list[float], turned_beyond: float) -> np.ndarray:
    """The blended normals of rays along z, each through a Gaussian whose normal has that cosine to it."""
    tilted = np.array([[np.sqrt(1 - c * c), 0.0, c] for c in cosines])
    means = np.stack([10.0 * np.arange(len(cosines)), np.zeros(len(cosines)), np.ones(len(cosines))], axis=1)
    gaussians = facing_z(means, opacities=0.8)
    gaussians.quats_wxyz = f32(quaternions_from_matrices(frames_from_normals(tilted)))
    rays = RayBatch(f32(means - [0, 0, 1]), f32(np.tile([[0, 0, 1]], (len(cosines), 1))))
    return make_tracer(gaussians, flip_normal_cos=turned_beyond).trace(rays).normal_world / 0.8


def test_normals_beyond_a_cosine_are_turned() -> None:
    cosines = [-0.9, -0.2, 0.2, 0.45, 0.55, 0.9]
    kept, turned = wall_seen_at(cosines, 0.5)[:, 2], wall_seen_at(cosines, 0.0)[:, 2]
    np.testing.assert_allclose(kept, [-0.9, -0.2, 0.2, 0.45, -0.55, -0.9], atol=1e-5)
    np.testing.assert_allclose(turned, -np.abs(cosines), atol=1e-5)


def test_facing_normals_blend_continuously_at_silhouette() -> None:
    # Just before and just behind the outline of a sphere, seen along z: x is the outline's normal.
    near = unit(np.array([[1.0, 0.0, -0.2], [1.0, 0.0, 0.2]]))
    gaussians = facing_z([[0, 0, 1.0], [0, 0, 1.5]], opacities=[0.5, 0.9])
    gaussians.quats_wxyz = f32(quaternions_from_matrices(frames_from_normals(near)))
    ray = RayBatch(f32([[0, 0, 0]]), f32([[0, 0, 1]]))
    kept = make_tracer(gaussians, flip_normal_cos=0.5).trace(ray).normal_world
    turned = make_tracer(gaussians).trace(ray).normal_world
    assert unit(kept)[0, 0] > 0.999
    assert abs(turned[0, 0]) < 0.1


def test_facing_normal_towards_viewer_is_unchanged() -> None:
    sums = np.array([[0.0, 0.3, -0.4], [0.0, 0.0, -2.0], [0.0, 0.0, 0.0]])
    found = face_viewer(f32(sums), f32(np.tile([[0, 0, 1]], (3, 1))))
    np.testing.assert_allclose(found.normal_world, [[0, 0.6, -0.8], [0, 0, -1], [0, 0, 0]], atol=1e-7)
    assert not found.is_away.any()


def test_facing_normal_away_is_perpendicular_to_ray(rng: np.random.Generator) -> None:
    directions = unit(rng.normal(size=(200, 3)))
    found = face_viewer(rng.normal(size=(200, 3)), directions)
    toward = -(found.normal_world * directions).sum(axis=1)
    assert 50 < found.is_away.sum() < 150
    assert (toward > 0.99 * MIN_VIEW_COSINE).all()
    np.testing.assert_allclose(np.linalg.norm(found.normal_world, axis=1), 1, atol=1e-12)
    across = found.blended_world - (found.blended_world * directions).sum(axis=1, keepdims=True) * directions
    cosine = (unit(across) * found.normal_world).sum(axis=1)
    clear = found.is_away & (np.linalg.norm(across, axis=1) > 0.2)
    assert (cosine[clear] > 1 - 2e-5).all()


def test_facing_normal_gradient_matches_finite_differences(rng: np.random.Generator) -> None:
    directions, sums = unit(rng.normal(size=(40, 3))), rng.normal(size=(40, 3))
    given = rng.normal(size=(40, 3))
    found = face_viewer(sums, directions)
    assert found.is_away.any()
    assert not found.is_away.all()
    slope, step = found.backward(given, directions), 1e-6
    for axis in range(3):
        moved = step * np.eye(3)[axis]
        change = (
            face_viewer(sums + moved, directions).normal_world
            - face_viewer(sums - moved, directions).normal_world
        )
        np.testing.assert_allclose(
            slope[:, axis], (given * change).sum(axis=1) / (2 * step), rtol=1e-5, atol=1e-6
        )
