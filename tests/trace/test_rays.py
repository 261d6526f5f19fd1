"""Batches of rays: limits, parts, mirrors, and ways between points."""

import numpy as np
import pytest

from octasplat.engine.core import rays as rays_module
from octasplat.engine.core.rays import ImageRays, RayBatch, concatenate_rays
from tests.support.trace_scenes import f32, unit


def test_ray_batch_keeps_views_and_scalar_limits(rng: np.random.Generator) -> None:
    origins, directions = f32(rng.normal(size=(4, 3))), f32(rng.normal(size=(4, 3)))
    rays = RayBatch(origins, directions)
    assert np.shares_memory(rays.origins_world, origins)
    assert np.shares_memory(rays.directions_world, directions)
    assert rays.t_min.tolist() == [0.0] and rays.t_max.tolist() == [np.inf]


@pytest.mark.parametrize("which", [slice(1, 3), np.array([3, 0]), np.array([True, False, False, True])])
def test_ray_batch_selection_keeps_limits(rng: np.random.Generator, which: slice | np.ndarray) -> None:
    directions, t_max = f32(rng.normal(size=(4, 3))), f32([1, 2, 3, 4])
    part = RayBatch(np.ones((1, 3)), directions, 0.5, t_max, -t_max)[which].with_t_max(t_max[which])
    np.testing.assert_array_equal(part.t_view_origin, -t_max[which])
    np.testing.assert_array_equal(part.directions_world, directions[which])
    np.testing.assert_array_equal(part.t_max, t_max[which])
    assert part.origins_world.tolist() == [[1, 1, 1]] and part.t_min.tolist() == [0.5]
    one = RayBatch(np.ones((1, 3)), directions[:1], 0.5, t_max[:1])
    assert len(one[np.array([], int)]) == 0 and len(one[np.array([0, 0])]) == 2


def test_ray_batches_join_with_shared_origins(rng: np.random.Generator) -> None:
    directions = f32(rng.normal(size=(5, 3)))
    both = concatenate_rays(
        RayBatch(np.ones((1, 3)), directions[:2], 0.5), RayBatch(np.zeros((1, 3)), directions[2:], 0.5)
    )
    np.testing.assert_array_equal(both.directions_world, directions)
    assert both.origins_world[:, 0].tolist() == [1, 1, 0, 0, 0] and both.t_min.tolist() == [0.5]
    one = RayBatch(np.ones((1, 3)), directions[:1])
    twice = concatenate_rays(one, one)
    assert len(twice) == 2 and len(twice.origins_world) == 1
    np.testing.assert_array_equal(twice.directions_world, directions[[0, 0]])


def test_ray_batch_between_points_has_their_distance(rng: np.random.Generator) -> None:
    ends = np.concatenate([rng.normal(size=(5, 3)), [[1.0, 2.0, 3.0]]])
    rays = RayBatch.between(np.array([[1.0, 2.0, 3.0]]), ends, gap=0.01)
    np.testing.assert_allclose(np.linalg.norm(rays.directions_world, axis=1), 1, atol=1e-6)
    reached = rays.origins_world + (rays.t_max + 0.01)[:, None] * rays.directions_world
    np.testing.assert_allclose(reached[:5], ends[:5], atol=1e-5)
    assert rays.t_max[5] == 0


def test_mirrored_rays_of_one_origin_have_one_origin(rng: np.random.Generator) -> None:
    normal, point = unit(rng.normal(size=3)), rng.normal(size=3)
    origin = point + 2.0 * normal
    directions = unit(-normal + 0.3 * rng.normal(size=(20, 3)))
    camera = RayBatch(np.tile(origin, (20, 1)), directions, 0.1, t_view_origin=-0.5)
    t_mirror = -2.0 / (directions @ normal)
    mirrored = camera.reflect(point, -3.0 * normal, t_mirror)
    np.testing.assert_allclose(mirrored.origins_world, np.tile(point - 2.0 * normal, (20, 1)), atol=1e-6)
    assert (mirrored.origins_world == mirrored.origins_world[0]).all()
    meeting = origin + t_mirror[:, None] * directions
    assert mirrored.t_view_origin.tolist() == [-0.5]
    np.testing.assert_allclose(mirrored.starts_world, meeting, atol=1e-5)
    np.testing.assert_allclose(mirrored.directions_world @ normal, -(directions @ normal), atol=1e-6)


def test_rays_of_an_image_are_row_by_row(rng: np.random.Generator) -> None:
    directions = f32(unit(rng.normal(size=(2, 3, 3))))
    image = ImageRays.from_directions(np.array([1.0, 2.0, 3.0]), directions, 0.25)
    assert (image.height_px, image.width_px) == (2, 3)
    assert image.origin_world.tolist() == [1, 2, 3] and image.rays.t_min.tolist() == [0.25]
    np.testing.assert_array_equal(image.rays.directions_world[4], directions[1, 1])
    np.testing.assert_array_equal(image.directions_world, directions)


@pytest.mark.parametrize("shape", [(23, 17), (1, 9), (9, 1), (2, 3)])
def test_rays_offset_some_rows_at_a_time_are_the_same(
    shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What differences take in float64 is several times the rays of a large picture."""
    ways = np.random.default_rng(0).normal((0, 0, 3), 1, (*shape, 3))
    image = ImageRays.from_directions(
        np.zeros(3), ways / np.linalg.norm(ways, axis=2, keepdims=True), 0.5, np.array([0.0, 0.0, 1.0])
    )
    together = image.shifted(0.25, -0.4)
    assert not np.array_equal(together.directions_world, image.directions_world)
    sizes: list[int] = []
    shifted_ways = rays_module._shifted_ways

    def counted(given: np.ndarray, across_px: float, down_px: float) -> np.ndarray:
        sizes.append(len(given))
        return shifted_ways(given, across_px, down_px)

    monkeypatch.setattr(rays_module, "_shifted_ways", counted)
    monkeypatch.setattr(rays_module, "SHIFTED_PIXELS_AT_ONCE", 2 * shape[1])
    parts = image.shifted(0.25, -0.4)
    assert max(sizes) <= 4
    np.testing.assert_array_equal(parts.directions_world, together.directions_world)
    assert parts.rays.t_min.tolist() == together.rays.t_min.tolist()
