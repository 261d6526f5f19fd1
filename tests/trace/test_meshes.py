"""Rays through triangles with known answers."""

import numpy as np
import pytest

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.trace.triangle_bvh import TriangleBvh
from tests.support.trace_scenes import f32

CUBE_CORNERS = f32([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
CUBE_FACES = np.array([face for a, b, c, d in QUADS for face in ((a, b, c), (a, c, d))])


@pytest.fixture(params=[(1, True), (2, True), (1, False)])
def cube(request: pytest.FixtureRequest) -> TriangleBvh:
    threads, is_watertight = request.param
    return TriangleBvh(CUBE_CORNERS, CUBE_FACES, threads=threads, is_watertight=is_watertight)


def test_rays_from_the_middle_of_a_cube(cube: TriangleBvh, rng: np.random.Generator) -> None:
    directions = f32(rng.normal(size=(500, 3)))  # of any length
    hits = cube.closest(RayBatch(np.zeros((1, 3)), directions))
    np.testing.assert_allclose(hits.distances, 1 / np.abs(directions).max(axis=1), rtol=1e-6)
    a, b, c = (CUBE_CORNERS[CUBE_FACES[hits.faces, k]] for k in range(3))
    u, v = hits.barycentrics[:, :1], hits.barycentrics[:, 1:]
    np.testing.assert_allclose(a + u * (b - a) + v * (c - a), hits.distances[:, None] * directions, atol=1e-6)


def test_mesh_hit_is_independent_of_batch(cube: TriangleBvh, rng: np.random.Generator) -> None:
    rays = RayBatch(f32(rng.normal(0, 3, (43, 3))), f32(rng.normal(size=(43, 3))))
    together, occluded = cube.closest(rays), cube.occluded(rays)
    for k in range(len(rays)):
        alone = cube.closest(rays[k : k + 1])
        assert alone.distances[0] == together.distances[k] and alone.faces[0] == together.faces[k]
        assert (alone.barycentrics[0] == together.barycentrics[k]).all()
        assert cube.occluded(rays[k : k + 1])[0] == occluded[k] == together.is_hit[k]


def test_ray_limits_select_hit(cube: TriangleBvh) -> None:
    origins, along = np.array([[0.2, 0.1, -3.0]]), np.tile([[0.0, 0.0, 1.0]], (5, 1))
    t_min = f32([0.0, 2.5, 4.5, 0.0, 2.5])
    t_max = f32([np.inf, np.inf, np.inf, 1.5, 3.5])
    rays = RayBatch(origins, along, t_min, t_max)
    # Embree's reciprocals are rounded otherwise on other processors.
    np.testing.assert_allclose(cube.closest(rays).distances, [2.0, 4.0, np.inf, np.inf, np.inf], rtol=1e-6)
    assert cube.closest(rays).is_hit.tolist() == [True, True, False, False, False]
    assert cube.occluded(rays).tolist() == [True, True, False, False, False]
    assert cube.closest(rays).faces[2] == -1


def test_zero_length_ray_hits_no_mesh(cube: TriangleBvh) -> None:
    rays = RayBatch(np.array([[0.0, 0.0, -3.0]]), np.array([[0.0, 0.0, 1.0]]), t_min=1.0, t_max=0.5)
    assert not cube.closest(rays).is_hit[0] and not cube.occluded(rays)[0]


def test_empty_mesh_is_never_hit() -> None:
    empty = TriangleBvh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    rays = RayBatch(np.zeros((3, 3)), np.eye(3))
    assert not empty.closest(rays).is_hit.any() and not empty.occluded(rays).any()


def test_mesh_queries_without_rays_are_empty(cube: TriangleBvh) -> None:
    rays = RayBatch(np.zeros((0, 3)), np.zeros((0, 3)))
    assert len(cube.closest(rays).faces) == 0 and len(cube.occluded(rays)) == 0


def test_face_index_out_of_range_is_refused() -> None:
    with pytest.raises(ValueError, match="not among the 8"):
        TriangleBvh(CUBE_CORNERS, np.array([[0, 1, 8]]))
