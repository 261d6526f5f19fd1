"""Marching cubes: closed and right-way-round for any values, near the surface for smooth ones."""

from dataclasses import replace

import numpy as np
import pytest
import skimage.measure
from scipy.spatial import cKDTree

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.geometry.triangle_mesh import edge_report
from octasplat.engine.surface.marching_cubes import marching_cubes
from octasplat.engine.surface.marching_cubes_table import EDGES, FACES, case_loops, case_triangles
from tests.support.surface_shapes import sphere, volume_of, voxel_centres


@pytest.mark.parametrize("case", range(256))
def test_marching_cases_separate_inside_from_outside(case):
    crossed = {k for k, (a, b) in enumerate(EDGES) if (case >> a & 1) != (case >> b & 1)}
    found = case_triangles(case)
    assert {edge for triangle in found for edge in triangle} == crossed
    assert len(found) == sum(len(loop) - 2 for loop in case_loops(case))
    # Every line inside the cell is shared by two triangles that wind alike; those on its faces by one.
    lines = [line for a, b, c in found for line in ((a, b), (b, c), (c, a))]
    assert len(lines) == len(set(lines))
    for a, b in lines:
        on_a_face = any(set(EDGES[a]) | set(EDGES[b]) <= set(face) for face in FACES)
        assert ((b, a) in lines) != on_a_face


def test_random_values_give_a_closed_surface():
    rng = np.random.default_rng(5)
    volume = volume_of(sphere, 3)
    values = rng.uniform(-1, 1, volume.values.shape).astype(np.float32)
    rim = np.abs(voxel_centres(volume.region, volume.blocks)).max(axis=2) > 11
    values[rim] = 1.0  # so that nothing is cut off by the end of the grid
    mesh = marching_cubes(replace(volume, values=values), 0.5)
    assert len(mesh.faces) > 10_000
    assert edge_report(mesh.faces).is_watertight


def test_sphere_lies_where_it_should_and_faces_outwards():
    mesh = marching_cubes(volume_of(sphere, 4), 0.5)
    assert edge_report(mesh.faces).is_watertight
    radii = np.linalg.norm(mesh.vertices_world, axis=1)
    assert np.abs(radii - 9).max() < 0.02  # in voxels
    corners = mesh.face_corners_world
    volume = np.sum(corners[:, 0] * np.cross(corners[:, 1], corners[:, 2])) / 6
    assert volume == pytest.approx(4 / 3 * np.pi * 9**3, rel=0.01)
    # Euler: a sphere has no handles.
    vertices, faces = len(mesh.vertices_world), len(mesh.faces)
    assert vertices - 3 * faces // 2 + faces == 2


def test_marching_cubes_matches_scikit_image():
    def blob(points):
        return np.linalg.norm(points * [1, 1.3, 0.8], axis=1) - 9 + 1.5 * np.sin(points).sum(axis=1)

    volume = volume_of(blob, 4)
    mesh = marching_cubes(volume, 0.5)
    dense = np.empty((32,) * 3, np.float32)
    for (x, y, z), values in zip(volume.blocks * 8, volume.values, strict=True):
        dense[x : x + 8, y : y + 8, z : z + 8] = values.reshape(8, 8, 8)
    vertices, faces, _, _ = skimage.measure.marching_cubes(dense, 0.0)
    assert mesh.face_areas.sum() == pytest.approx(
        skimage.measure.mesh_surface_area(vertices, faces), rel=0.01
    )
    ours = (mesh.vertices_world - volume.region.low) / volume.region.voxel - 0.5
    assert len(ours) == len(vertices)
    assert cKDTree(vertices).query(ours)[0].max() < 0.02


def test_marching_cubes_leaves_unobserved_cells_open():
    volume = volume_of(sphere, 4)
    height = voxel_centres(volume.region, volume.blocks)[..., 2]
    weights = np.where(height < 3, 1.0, 0.0).astype(np.float32)
    mesh = marching_cubes(replace(volume, weights=weights), 0.5)
    assert mesh.vertices_world[:, 2].max() <= 3
    report = edge_report(mesh.faces)
    assert report.open_edges > 20
    assert report.non_manifold_edges == report.inconsistent_edges == 0


def test_marching_cubes_missing_blocks_are_unobserved():
    volume = volume_of(sphere, 4)
    table = volume.table.copy()
    table[:, :, 3] = -1
    kept = table[tuple(volume.blocks.T)] >= 0
    table[tuple(volume.blocks[kept].T)] = np.arange(kept.sum())
    part = replace(
        volume,
        table=table,
        blocks=volume.blocks[kept],
        values=volume.values[kept],
        weights=volume.weights[kept],
    )
    mesh = marching_cubes(part, 0.5)
    assert mesh.vertices_world[:, 2].max() <= 8
    assert edge_report(mesh.faces).open_edges > 20


def test_marching_cubes_without_surface_is_refused():
    with pytest.raises(ConfigError, match="No surface"):
        marching_cubes(volume_of(lambda points: np.ones(len(points)), 2), 0.5)
