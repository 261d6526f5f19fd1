"""Colors fitted to pictures, where the right ones are known; what closes a mesh beyond what was seen."""

from functools import partial

import numpy as np

from octasplat.engine.core.color import to_bytes
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.geometry.triangle_mesh import TriangleMesh, edge_report
from octasplat.engine.surface.backdrop import with_backdrop
from octasplat.engine.surface.color_fit import Picture, TexturePalette, VertexPalette, fit_colors
from octasplat.engine.surface.marching_cubes import marching_cubes
from octasplat.engine.surface.texture import unwrap
from octasplat.engine.surface.tsdf_volume import fill_unseen
from octasplat.engine.surface.vertex_refinement import refine_vertices
from octasplat.engine.trace.triangle_bvh import TriangleBvh
from tests.support.surface_shapes import cameras_on_sphere, sphere, volume_of


def painted(points_world: np.ndarray) -> np.ndarray:
    """Colors that change smoothly over a ball."""
    return (0.5 + 0.4 * np.sin(2 * points_world)).astype(np.float32)


def pictures_of(mesh: TriangleMesh, count: int = 20) -> list[Picture]:
    """Of the painted surface, before nothing; alpha is one where there is surface."""
    scene, pictures = TriangleBvh(mesh.vertices_world, mesh.faces), []
    for camera in cameras_on_sphere(count, 3.0, 96):
        rays = camera.rays()
        hits = scene.closest(rays.rays)
        rgba = np.zeros((len(hits.is_hit), 4), np.float32)
        at = rays.origin_world + hits.distances[hits.is_hit, None] * rays.rays.directions_world[hits.is_hit]
        rgba[hits.is_hit, :3], rgba[hits.is_hit, 3] = painted(at), 1.0
        pictures.append(partial(lambda *both: both, rays, to_bytes(rgba).reshape(96, 96, 4)))
    return pictures


def ball() -> TriangleMesh:
    mesh = marching_cubes(volume_of(lambda points: sphere(points, 1.0), 3, 0.125), 0.5)
    return TriangleMesh(mesh.vertices_world, mesh.faces)


def test_wrong_colors_of_vertices_are_put_right():
    mesh = ball()
    wrong = np.random.default_rng(0).random((len(mesh.vertices_world), 3)).astype(np.float32)
    right = painted(mesh.vertices_world)
    found, _ = fit_colors(VertexPalette(mesh), wrong, pictures_of(mesh))
    assert np.abs(found - right).mean() < 0.03 < 0.2 < np.abs(wrong - right).mean()
    np.testing.assert_allclose(fit_colors(VertexPalette(mesh), right, pictures_of(mesh))[0], right, atol=0.03)


def test_wrong_colors_of_a_texture_are_put_right():
    layout = unwrap(ball(), 128)
    right = painted(layout.points_world)
    wrong = np.full_like(right, 0.5)
    found, _ = fit_colors(TexturePalette(layout), wrong, pictures_of(layout.mesh))
    assert np.abs(found - right).mean() < 0.03 < 0.2 < np.abs(wrong - right).mean()


def test_color_fit_keeps_unseen_vertices():
    mesh = ball()
    start = np.full((len(mesh.vertices_world), 3), 0.25, np.float32)
    found, seen = fit_colors(VertexPalette(mesh), start, [])
    np.testing.assert_array_equal(found, start)
    assert not seen.any()


def test_vertex_refinement_moves_surface_to_photo_consistency():
    mesh = ball()
    radii = np.linalg.norm(mesh.vertices_world, axis=1, keepdims=True)
    bumps = 1 + 0.03 * np.sin(5 * mesh.vertices_world[:, :1]) * np.cos(4 * mesh.vertices_world[:, 1:2])
    bumpy = TriangleMesh((mesh.vertices_world / radii * bumps).astype(np.float32), mesh.faces)

    def off(surface: TriangleMesh) -> float:
        return float(np.abs(np.linalg.norm(surface.vertices_world, axis=1) - 1).mean())

    better = refine_vertices(bumpy, pictures_of(mesh))
    assert off(better) < 0.7 * off(bumpy)
    np.testing.assert_array_equal(better.faces, bumpy.faces)


def test_unseen_space_is_closed_where_it_is_solid():
    def half_seen():
        volume = volume_of(lambda points: sphere(points, 1.0), 3, 0.125)
        volume.weights[len(volume.weights) // 2 :] = 0.1
        return volume

    assert edge_report(marching_cubes(half_seen(), 0.5).faces).open_edges > 0
    volume = half_seen()
    fill_unseen(volume, 0.5)
    inside = np.abs(marching_cubes(volume, 0.5).vertices_world).max(axis=1) < 1.2
    assert inside.sum() > 100
    whole = marching_cubes(volume, 0.5)
    rim = edge_report(whole.faces).open_edges
    # Only where the grid itself ends is it still open.
    ends = np.abs(whole.vertices_world).max(axis=1) > 1.3
    assert rim <= 3 * ends.sum()


def test_backdrop_is_closed_and_stops_rays():
    mesh = ball()
    both = with_backdrop(mesh, np.zeros(3))
    np.testing.assert_array_equal(both.faces[: len(mesh.faces)], mesh.faces)
    sphere_only = both.select_faces(np.arange(len(mesh.faces), len(both.faces)))
    assert edge_report(sphere_only.faces).is_watertight
    ways = np.random.default_rng(0).standard_normal((1000, 3))
    hits = TriangleBvh(sphere_only.vertices_world, sphere_only.faces).closest(
        RayBatch(np.zeros((1, 3)), ways / np.linalg.norm(ways, axis=1, keepdims=True))
    )
    assert hits.is_hit.all()
    corners = sphere_only.face_corners_world
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert ((across * corners.mean(axis=1)).sum(axis=1) < 0).all()  # seen from inside
