"""Components, holes and decimation."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.ndimage import gaussian_filter

from octasplat.engine.geometry.triangle_mesh import TriangleMesh, edge_report
from octasplat.engine.surface.holes import boundary_loops, fill_holes
from octasplat.engine.surface.marching_cubes import marching_cubes
from octasplat.engine.surface.mesh_cleanup import decimate, face_components, keep_largest_components
from tests.support.daily import some_daily
from tests.support.surface_shapes import sphere, volume_of


def joined(*meshes: TriangleMesh) -> TriangleMesh:
    starts = np.cumsum([0, *(len(mesh.vertices_world) for mesh in meshes[:-1])]).astype(np.int32)
    return TriangleMesh(
        np.concatenate([mesh.vertices_world for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
    )


def ball(radius: float = 9.0) -> TriangleMesh:
    return marching_cubes(volume_of(lambda points: sphere(points, radius), 4), 0.5)


def test_mesh_repair_removes_small_components():
    large, middle, small = ball(12), ball(6), ball(2)
    mesh = joined(small, large, middle)
    assert len(np.unique(face_components(mesh))) == 3
    assert len(keep_largest_components(mesh, keep=1).faces) == len(large.faces)
    assert len(keep_largest_components(mesh, min_share=0.1).faces) == len(large.faces) + len(middle.faces)
    kept = keep_largest_components(mesh, min_share=0.0)
    np.testing.assert_array_equal(kept.faces, mesh.faces)


def without(mesh: TriangleMesh, *axes: tuple[float, float, float], reach: float = 0.9) -> TriangleMesh:
    """The mesh of a ball with round holes cut around directions."""
    middles = mesh.face_corners_world.mean(axis=1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    cut = np.any([middles @ np.array(axis) > reach for axis in axes], axis=0)
    return mesh.select_faces(~cut)


def test_mesh_repair_finds_boundary_loops():
    mesh = without(ball(), (0, 0, 1), (1, 0, 0))
    found = boundary_loops(mesh.faces)
    assert len(found) == 2
    assert sum(len(rim) for rim in found) == edge_report(mesh.faces).open_edges
    assert boundary_loops(ball().faces) == []


def test_mesh_repair_closing_all_holes_is_watertight():
    whole = ball()
    mesh, closed = fill_holes(without(whole, (0, 0, 1), (1, 0, 0), (0, -1, 0)), None)
    assert closed == 3
    assert edge_report(mesh.faces).is_watertight
    as_theirs = trimesh.Trimesh(mesh.vertices_world, mesh.faces, process=False)
    assert as_theirs.is_watertight
    assert as_theirs.is_winding_consistent
    # Flat lids take little off the ball: caps of height 0.1 radii.
    cap = np.pi * (0.9) ** 2 * (3 * 9 - 0.9) / 3
    assert as_theirs.volume == pytest.approx(4 / 3 * np.pi * 9**3 - 3 * cap, rel=0.01)


def test_mesh_repair_closes_small_holes_only():
    mesh = without(ball(), (0, 0, 1), reach=0.6)
    mesh = mesh.select_faces(np.arange(len(mesh.faces)) != 100)
    before = edge_report(mesh.faces).open_edges
    filled, closed = fill_holes(mesh, 6.0)
    assert closed == 1
    assert edge_report(filled.faces).open_edges == before - 3


def test_mesh_repair_open_sheet_gets_back_only_when_closing_all(sheet):
    same, closed = fill_holes(sheet, 3.9)
    assert closed == 0
    assert same is sheet
    both, closed = fill_holes(sheet, None)
    assert closed == 1
    assert edge_report(both.faces).is_watertight


def test_holes_sharing_a_vertex(sheet):
    # Two missing squares that share one corner: their rim passes it twice.
    corner = [5 * 20 + 5, 6 * 20 + 6]
    gone = np.array(corner + [c + 400 for c in corner])
    mesh = sheet.select_faces(np.setdiff1d(np.arange(len(sheet.faces)), gone))
    filled, closed = fill_holes(mesh, 1.0)
    assert closed == 2
    assert edge_report(filled.faces).open_edges == edge_report(sheet.faces).open_edges
    assert filled.face_areas.sum() == pytest.approx(1.0)


def test_decimation_keeps_the_shape_and_stays_closed():
    whole = ball(12)
    small = decimate(whole, 1000)
    assert 900 <= len(small.faces) <= 1000
    assert edge_report(small.faces).is_watertight
    radii = np.linalg.norm(small.vertices_world, axis=1)
    assert np.abs(radii - 12).max() < 0.15
    assert decimate(small, 5000) is small


def test_decimation_of_thin_parts_is_not_tangled():
    def frame(points):  # three thin bars that cross
        near = [np.linalg.norm(np.delete(points, axis, axis=1), axis=1) for axis in range(3)]
        return np.maximum(np.minimum.reduce(near) - 1.2, np.abs(points).max(axis=1) - 13)

    whole = marching_cubes(volume_of(frame, 4), 0.5)
    assert edge_report(whole.faces).is_watertight
    for count in (400, 150, 60):
        small = decimate(whole, count)
        assert edge_report(small.faces).is_watertight, count
        assert len(small.faces) <= count + 10


def torn(seed: int) -> TriangleMesh:
    """A ball of noise in which not every voxel was seen: its parts touch at corners, and holes abound."""
    random = np.random.default_rng(seed)
    noise = gaussian_filter(random.standard_normal((32, 32, 32)), 1.0)
    noise *= 5 / noise.std()
    whole = volume_of(lambda p: sphere(p) + noise[tuple(np.clip((p + 16).astype(int), 0, 31).T)], 4)
    weights = (random.random(whole.weights.shape) > 0.03).astype(np.float32)
    return marching_cubes(replace(whole, weights=weights), 0.5)


@pytest.mark.parametrize("seed", some_daily([0, 2], [2]))
def test_mesh_repair_keeps_closed_component(seed):
    whole = torn(seed)
    one, closed = fill_holes(keep_largest_components(whole, keep=1), None)
    assert closed > 100
    small = keep_largest_components(decimate(one, 3000), keep=1)
    every, _ = fill_holes(whole, None)
    for mesh, parts in ((one, 1), (small, 1), (every, None)):
        as_theirs = trimesh.Trimesh(mesh.vertices_world, mesh.faces, process=False)
        assert as_theirs.is_watertight and as_theirs.is_winding_consistent
        assert edge_report(mesh.faces).is_watertight
        assert as_theirs.unique_faces().all()
        if parts is not None:
            assert as_theirs.body_count == parts
            assert len(face_components(mesh)) == len(mesh.faces) and face_components(mesh).max() == parts - 1


def test_fill_holes_single_triangle_becomes_watertight():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    filled, closed = fill_holes(TriangleMesh(corners, np.array([[0, 1, 2]], np.int32)), None)
    assert closed == 1 and edge_report(filled.faces).is_watertight
    assert len(np.unique(np.sort(filled.faces, axis=1), axis=0)) == len(filled.faces) == 4


def test_mesh_normals_point_outwards():
    mesh = ball()
    outwards = mesh.vertices_world / np.linalg.norm(mesh.vertices_world, axis=1, keepdims=True)
    assert (np.sum(mesh.vertex_normals() * outwards, axis=1) > 0.97).all()
