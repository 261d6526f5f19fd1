"""Distances between surfaces with known answers."""

from dataclasses import replace

import numpy as np
import pytest

from octasplat.engine.evaluate.surface_metrics import (
    distances_to_surface,
    point_triangle_distances,
    sample_surface,
    surface_metrics,
)
from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from octasplat.engine.surface.occlusion import Occluder


def test_distance_to_each_part_of_a_triangle():
    triangle = np.array([[0.0, 0, 0], [2, 0, 0], [0, 2, 0]])
    cases = [
        ([0.5, 0.5, 3.0], 3.0),
        ([0.5, 0.5, -1.0], 1.0),
        ([1.0, -2.0, 0.0], 2.0),
        ([-3.0, -4.0, 0.0], 5.0),
        ([2.0, 2.0, 0.0], np.sqrt(2)),
        ([5.0, 0.0, 4.0], 5.0),
    ]
    points = np.array([point for point, _ in cases])
    found = point_triangle_distances(points, np.broadcast_to(triangle, (len(points), 3, 3)).copy())
    np.testing.assert_allclose(found, [distance for _, distance in cases])


def test_distance_to_triangle_without_area_is_that_to_its_line() -> None:
    line = np.array([[[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[1.0, 1, 1]] * 3])
    found = point_triangle_distances(np.array([[1.0, 3, 4], [1, 1, 3]]), line)
    np.testing.assert_allclose(found, [5.0, 2.0])


def test_samples_are_uniform_over_the_area(sheet):
    points, faces = sample_surface(sheet, 40_000, np.random.default_rng(0))
    np.testing.assert_allclose(points.mean(axis=0), [0.5, 0.5, 0], atol=0.01)
    assert np.bincount(faces, minlength=800).max() < 100


def test_mesh_comparison_of_shifted_sheet_has_known_distance(sheet):
    rng = np.random.default_rng(1)
    lifted = replace(sheet, vertices_world=sheet.vertices_world + np.float32([0, 0, 0.03]))
    points, _ = sample_surface(lifted, 5000, rng)
    distances = distances_to_surface(points, sheet, rng, 100_000)
    assert distances.min() >= 0.03 - 1e-6
    assert np.quantile(distances, 0.99) < 0.03 + 1e-6
    assert distances.max() < 0.0303
    half = sheet.select_faces(sheet.face_corners_world[..., 0].max(axis=1) < 0.51)
    to_half = distances_to_surface(points, half, rng, 100_000)
    result = surface_metrics(
        distances_to_surface(sample_surface(half, 5000, rng)[0], sheet, rng), to_half, 0.05
    )
    assert result.precision == 1.0
    assert result.accuracy < 1e-6
    assert result.recall == pytest.approx(0.5 + 0.04, abs=0.02)
    assert result.f_score == pytest.approx(2 * result.recall / (1 + result.recall))
    assert result.chamfer == pytest.approx(0.5 * (result.accuracy + result.completeness))


def test_occluder_hides_points_behind_mesh(sheet):
    occluder = Occluder(sheet)
    above, below = np.array([[0.5, 0.5, 1.0]]), np.array([[0.5, 0.5, -1.0]])
    beside = np.array([[3.0, 0.5, -1.0]])
    on_it = np.array([[0.5, 0.5, 0.0]])
    assert not occluder.is_visible(below, above)[0]
    assert occluder.is_visible(below, beside)[0]
    assert occluder.is_visible(on_it, above)[0]
    deeper = np.array([[0.5, 0.5, -0.05]])
    assert not occluder.is_visible(deeper, above)[0]
    assert occluder.is_visible(deeper, above, tolerance=0.1)[0]


def test_mesh_comparison_without_points_scores_zero():
    nothing = surface_metrics(np.array([1.0]), np.array([1.0]), 0.1)
    assert nothing.f_score == 0.0
    assert TriangleMesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)).face_areas.sum() == 0
