"""The first Gaussians."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.synthetic.still_life import build_still_life
from octasplat.engine.train.config import preset, with_materials
from octasplat.engine.train.initialization.initial_gaussians import (
    gaussians_from_points,
    gaussians_from_rays,
    initial_train_state,
)
from tests.support.tiny_dataset import make_tiny_dataset

CAMERAS = np.array([[0.0, 0.0, -3.0], [1.0, 0.0, -3.0], [0.0, 1.0, -3.0]])


def start(xyz: np.ndarray, rgb: object = 0.5, **options: object):
    settings = {"extent": 1.0, "limit": 10_000, "opacity": 0.1, "rng": np.random.default_rng(0), **options}
    colors = np.broadcast_to(np.asarray(rgb, np.float32), (len(xyz), 3)).copy()
    return gaussians_from_points(xyz.astype(np.float32), colors, CAMERAS, **settings)


def grid(side: int = 12, spacing: float = 0.05) -> np.ndarray:
    x, y = np.meshgrid(np.arange(side) * spacing, np.arange(side) * spacing)
    return np.stack([x.ravel(), y.ravel(), np.zeros(side * side)], axis=-1)


def test_initialise_plane_points_align_normals() -> None:
    tilt = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    first = start(grid() @ tilt.T)
    assert np.abs(first.rotations[:, :, 0] @ tilt[:, 2]).min() > 1 - 1e-5


def test_scales_are_the_spacing_of_the_points() -> None:
    first = start(grid(spacing=0.05))
    inner = first.scales.reshape(12, 12, 2)[1:-1, 1:-1]
    np.testing.assert_allclose(inner, 0.05, rtol=1e-4)
    assert (first.log_scales[:, 0] == first.log_scales[:, 1]).all()


def test_initialise_sets_opacity_and_color() -> None:
    first = start(grid(), rgb=[0.9, 0.2, 0.5], opacity=0.3)
    np.testing.assert_allclose(first.opacities, 0.3, rtol=1e-5)
    np.testing.assert_allclose(first.base_rgb_srgb, [[0.9, 0.2, 0.5]] * 144, atol=1e-6)
    assert first.sh_degree == 0


def test_scattered_points_face_the_cameras() -> None:
    xyz = np.random.default_rng(0).uniform(-1, 1, (300, 3))
    first = start(xyz)
    towards = np.median(CAMERAS, axis=0) - xyz
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    cosines = np.abs((first.rotations[:, :, 0] * towards).sum(axis=1))
    assert np.median(cosines) > 0.999


def test_matching_errors_are_dropped() -> None:
    bad = np.array([[1e4, 0, 0], [0, 0, np.nan], [np.inf, 0, 0]])
    first = start(np.concatenate([grid(), bad]))
    assert len(first) == 144 and first.is_finite()


def test_too_many_points_are_thinned() -> None:
    xyz = grid(20)
    first = start(xyz, limit=50)
    assert len(first) == 50
    assert len(np.unique(first.means_world, axis=0)) == 50
    again = start(xyz, limit=50)
    np.testing.assert_array_equal(first.means_world, again.means_world)


@pytest.mark.parametrize("count", [1, 2, 5, 9])
def test_initialise_few_points_is_finite(count: int) -> None:
    first = start(grid()[:count])
    assert len(first) == count and first.is_finite() and (first.scales > 0).all()


def test_points_in_one_place() -> None:
    first = start(np.zeros((20, 3)))
    assert first.is_finite() and (first.scales > 0).all()


def test_initialise_point_at_camera_is_finite() -> None:
    assert start(np.concatenate([np.median(CAMERAS, axis=0)[None], grid()])).is_finite()


def test_initialise_without_usable_points_is_refused() -> None:
    with pytest.raises(DatasetError, match="lies near the cameras"):
        start(np.full((5, 3), np.nan))


@pytest.mark.parametrize("count", [1, 3, 500])
def test_random_ones_lie_on_their_rays_and_face_the_camera(count: int) -> None:
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(count, 3)).astype(np.float32)
    directions = rng.normal(size=(count, 3))
    directions = (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)
    first = gaussians_from_rays(
        origins, directions, np.full((count, 3), 0.25, np.float32), extent=2.0, opacity=0.1, rng=rng
    )
    away = first.means_world - origins
    depth = np.linalg.norm(away, axis=1)
    np.testing.assert_allclose(away / depth[:, None], directions, atol=1e-4)
    assert depth.min() > 0.1 and depth.max() < 100
    assert np.abs((first.rotations[:, :, 0] * directions).sum(axis=1)).min() > 1 - 1e-5
    assert first.is_finite() and (first.scales > 0).all()
    np.testing.assert_allclose(first.base_rgb_srgb, 0.25, atol=1e-6)


def test_normals_face_the_views_that_observe_the_points() -> None:
    thin_plate = np.concatenate([grid(), grid() + np.array([0, 0, 0.2])])
    seen_from = np.repeat([[0.6, 0.0, -0.8], [0.0, 0.6, 0.8]], 144, axis=0)
    normals = start(thin_plate, seen_from=seen_from).rotations[:, :, 0]
    np.testing.assert_allclose(normals, np.repeat([[0, 0, -1.0], [0, 0, 1.0]], 144, axis=0), atol=1e-5)


def test_normals_of_points_along_a_wire_stand_across_it() -> None:
    rng = np.random.default_rng(1)
    around = np.arange(80) * 2.4
    ring = np.stack([np.cos(around), np.sin(around), np.zeros(80)], axis=-1)
    wire = 0.01 * ring + np.arange(80)[:, None] * [0, 0, 0.03]
    seen_from = ring + np.array([0.0, 0.0, 0.5])  # each point from its own side, and from above
    seen_from /= np.linalg.norm(seen_from, axis=1, keepdims=True)
    first = start(wire + rng.normal(0, 1e-4, wire.shape), seen_from=seen_from)
    outwards = (first.rotations[:, :, 0] * ring).sum(axis=1)
    assert outwards.min() > 0.8 and np.median(outwards) > 0.98


def test_points_without_observations_face_the_cameras() -> None:
    normals = start(grid(), seen_from=np.zeros((144, 3))).rotations[:, :, 0]
    np.testing.assert_allclose(normals, [[0, 0, -1.0]] * 144, atol=1e-5)


def test_materials_begin_with_normals_that_point_out_of_the_things(
    tmp_path_factory: pytest.TempPathFactory, tmp_path: Path
) -> None:
    scene = make_tiny_dataset(tmp_path_factory, views=16, points=1200)
    dataset = Dataset.open(scene, tmp_path / "cache")
    first = initial_train_state(dataset, with_materials(preset("fast"))).gaussians
    life = build_still_life()
    nearest = cKDTree(life.vertices).query(first.means_world)[1]
    cosines = (first.rotations[:, :, 0] * life.vertex_normals[nearest]).sum(axis=1)
    assert (cosines > 0).mean() > 0.97
