"""Depth maps of a sphere fused into a volume."""

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.geometry.triangle_mesh import edge_report
from octasplat.engine.surface.depth_maps import DepthMaps
from octasplat.engine.surface.marching_cubes import marching_cubes
from octasplat.engine.surface.options import ExtractionOptions
from octasplat.engine.surface.region import choose_region, focus_point
from octasplat.engine.surface.tsdf_volume import fuse_depth_maps
from tests.support.surface_shapes import cameras_on_sphere, sphere_depth

RADIUS = 1.0


def sphere_maps(
    count: int = 40, side_px: int = 96, distance: float = 3.0, radius: float = RADIUS
) -> DepthMaps:
    cameras = cameras_on_sphere(count, distance, side_px)
    maps = [sphere_depth(camera, radius) for camera in cameras]
    return DepthMaps(tuple(cameras), tuple(d for d, _ in maps), tuple(c for _, c in maps))


def mesh_of(maps, **settings):
    options = ExtractionOptions(**settings)
    region = choose_region(maps, options)
    return marching_cubes(fuse_depth_maps(maps, region, options), options.min_weight), region


def test_sphere_from_all_sides_is_closed_and_exact():
    mesh, _region = mesh_of(sphere_maps(), resolution=96)
    assert edge_report(mesh.faces).is_watertight
    radii = np.linalg.norm(mesh.vertices_world, axis=1)
    assert np.abs(radii - RADIUS).max() < 0.015
    assert np.sqrt(np.mean((radii - RADIUS) ** 2)) < 0.007


def test_region_is_volume_inside_camera_ring():
    cameras = cameras_on_sphere(20, 3.0, 16)
    centre, distance = focus_point(cameras)
    np.testing.assert_allclose(centre, 0, atol=1e-6)
    assert distance == pytest.approx(3.0)


def test_region_is_visible_volume():
    maps = sphere_maps()
    region = choose_region(maps, ExtractionOptions(resolution=64))
    np.testing.assert_allclose(region.low, -1.1, atol=0.02)  # the ball and a margin
    assert region.voxel == pytest.approx(2.2 / 64, rel=0.02)
    assert region.truncation == pytest.approx(0.03 * 3 / region.voxel, abs=1e-3) or region.truncation == 4
    coarse = choose_region(maps, ExtractionOptions())
    assert coarse.voxel == pytest.approx(1.5 * 3 / maps.cameras[0].fx_px)
    behind = DepthMaps(maps.cameras, tuple(d + 10 for d in maps.distances), maps.cosines)
    with pytest.raises(ConfigError, match="No surface"):
        choose_region(behind, ExtractionOptions())


def test_box_and_voxel_are_kept():
    mesh, region = mesh_of(sphere_maps(), box=(-2, -2, 0.25, 2, 2, 2), voxel=0.05)
    assert region.voxel_world == 0.05
    assert mesh.vertices_world[:, 2].min() > 0.25
    assert edge_report(mesh.faces).open_edges > 50  # cut off by the box


@pytest.mark.exhaustive
def test_fusion_unbounded_covers_near_and_far():
    # Cameras inside a sphere 12 times as large as the ring that they stand on, a small ball in their midst.
    cameras = cameras_on_sphere(60, 1.0, 96, fov=70.0)
    near, far = 0.4, 12.0
    distances, cosines = [], []
    for camera in cameras:
        distance, cosine = sphere_depth(camera, near)
        rays = camera.rays()
        origin, directions = rays.origin_world, rays.directions_world
        along = directions.astype(np.float64) @ origin
        out = -along + np.sqrt(along**2 + far**2 - origin.astype(np.float64) @ origin)
        missed = ~np.isfinite(distance)
        distances.append(np.where(missed, out, distance).astype(np.float32))
        cosines.append(np.where(missed, 1.0, cosine).astype(np.float32))
    maps = DepthMaps(tuple(cameras), tuple(distances), tuple(cosines))
    mesh, _ = mesh_of(maps, unbounded=True, resolution=256)
    radii = np.linalg.norm(mesh.vertices_world, axis=1)
    inner = radii < 5
    assert inner.sum() > 500
    assert np.abs(radii[inner] - near).max() < 0.02
    assert (~inner).sum() > 500
    assert np.abs(np.median(radii[~inner]) - far) < 0.15 * far


def test_fusion_outlier_depth_of_one_view_is_removed():
    maps = sphere_maps()
    distances = list(maps.distances)
    bad = distances[7].copy()
    bad[:20, :20] = 1.0  # a floater before the camera, in front of free space
    distances[7] = bad
    mesh, region = mesh_of(DepthMaps(maps.cameras, tuple(distances), maps.cosines), resolution=96)
    radii = np.linalg.norm(mesh.vertices_world, axis=1)
    assert np.abs(radii - RADIUS).max() < region.voxel_world


def test_fusion_unknown_depth_leaves_hole():
    maps = sphere_maps()
    distances = []
    for camera, known in zip(maps.cameras, maps.distances, strict=True):
        rays = camera.rays()
        origin, directions = rays.origin_world, rays.directions_world
        hit = origin + np.where(np.isfinite(known), known, 0)[..., None] * directions
        distances.append(np.where(np.isfinite(known) & (hit[..., 2] > 0.7), 0, known).astype(np.float32))
    mesh, region = mesh_of(DepthMaps(maps.cameras, tuple(distances), maps.cosines), resolution=96)
    assert mesh.vertices_world[:, 2].max() < 0.7 + 2 * region.voxel_world
    assert edge_report(mesh.faces).open_edges > 20


def test_fusion_is_independent_of_view_order():
    maps = sphere_maps(count=12)
    turned = DepthMaps(maps.cameras[::-1], maps.distances[::-1], maps.cosines[::-1])
    one, _ = mesh_of(maps, box=(-1.5,) * 3 + (1.5,) * 3, resolution=48)
    two, _ = mesh_of(turned, box=(-1.5,) * 3 + (1.5,) * 3, resolution=48)
    np.testing.assert_array_equal(one.faces, two.faces)
    np.testing.assert_allclose(one.vertices_world, two.vertices_world, atol=1e-5)


def test_fusion_refusals_name_remedy():
    maps = sphere_maps(count=4)
    with pytest.raises(ConfigError, match="allowed"):
        mesh_of(maps, resolution=64, max_memory_gb=1e-4)
    with pytest.raises(ConfigError, match="--box"):
        mesh_of(maps, box=(10, 10, 10, 11, 11, 11))
    with pytest.raises(ConfigError, match="larger voxels"):
        mesh_of(maps, voxel=1e-5)
    with pytest.raises(ConfigError, match="no common centre"):
        focus_point([camera for camera in maps.cameras[:1] for _ in range(3)])
