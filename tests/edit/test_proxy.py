"""Proxies against exact maps, and no tearing."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial import KDTree

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.threads import threads_in_use, use_threads
from octasplat.engine.edit.deform import deform, deform_to, deformation_corners
from octasplat.engine.edit.near_triangles import NearTriangles
from octasplat.engine.edit.neighbors import interpolate_motion, neighbour_rotations
from octasplat.engine.edit.proxy import MeanValueBinding, Proxy, bind_corners
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.spherical_harmonics import sh_basis
from tests.support.edit_scenes import (
    assert_same,
    bend,
    covariance_errors,
    covariances,
    cube,
    grid,
    moved_covariances,
    random_turn,
    twist,
)

Make = Callable[..., FlatGaussians]
SHEAR = np.array([[1.2, 0.3, 0.0], [0.0, 0.8, 0.1], [0.2, 0.0, 1.0]])


def near_the_plane(make_scene: Make, thickness: float) -> FlatGaussians:
    g = make_scene(500, size=0.004)  # so small that their own bending does not count
    g.means_world[:, 2] *= thickness
    return g


def follow(
    g: FlatGaussians, proxy: Proxy, move: Callable[[np.ndarray], np.ndarray], **options
) -> FlatGaussians:
    corners = deformation_corners(g)
    binding = bind_corners(proxy, corners, **options)
    vertices = move(proxy.vertices_world)
    return deform_to(g, corners, binding.deform(vertices), binding.mirrored_mask(vertices))[0]


@pytest.mark.parametrize("method", ["nearest", "mvc"])
def test_similarity_transform_is_exact(make_scene: Make, method: str) -> None:
    g = make_scene(300)
    turn = random_turn(1)
    proxy = Proxy(*(cube(3) if method == "mvc" else grid(8)))
    result = follow(g, proxy, lambda p: 1.3 * p @ turn.T + [1, 2, 3], method=method, reach_world=np.inf)
    np.testing.assert_allclose(result.means_world, 1.3 * g.means_world @ turn.T + [1, 2, 3], atol=1e-6)
    assert covariance_errors(result, 1.69 * turn @ covariances(g) @ turn.T).max() < 1e-5


def test_affine_map_is_exact_in_cage(make_scene: Make) -> None:
    g = make_scene(300)
    result = follow(g, Proxy(*cube(2)), lambda p: p @ SHEAR.T, method="mvc")
    np.testing.assert_allclose(result.means_world, g.means_world @ SHEAR.T, atol=1e-6)
    assert covariance_errors(result, SHEAR @ covariances(g) @ SHEAR.T).max() < 1e-5


def test_affine_map_is_exact_on_surface(make_scene: Make) -> None:
    g = near_the_plane(make_scene, 0.0)
    g.quats_wxyz[:] = [np.sqrt(0.5), 0, np.sqrt(0.5), 0]  # the normal along z
    result = follow(g, Proxy(*grid(8)), lambda p: p @ SHEAR.T)
    np.testing.assert_allclose(result.means_world, g.means_world @ SHEAR.T, atol=1e-6)
    assert covariance_errors(result, SHEAR @ covariances(g) @ SHEAR.T).max() < 1e-5


def test_bent_sheet_error_is_second_order(make_scene: Make) -> None:
    g = near_the_plane(make_scene, 0.05)
    move, derivative = bend(1.0)
    worst, shapes = [], []
    for cells in (12, 24, 48):
        result = follow(g, Proxy(*grid(cells)), move)
        worst.append(float(np.linalg.norm(result.means_world - move(g.means_world), axis=1).max()))
        shapes.append(float(np.median(covariance_errors(result, moved_covariances(g, derivative)))))
    # Cells of 0.2, 0.1 and 0.05 at a radius of 1.
    assert worst[0] < 1.5e-2 and worst[1] < 0.5 * worst[0] and worst[2] < 0.6 * worst[1]
    assert shapes[2] < 0.02


def test_proxy_twist_follows_sheet_to_second_order(make_scene: Make) -> None:
    g = near_the_plane(make_scene, 0.0)
    g.quats_wxyz[:] = [np.sqrt(0.5), 0, np.sqrt(0.5), 0]
    move, derivative = twist(1.0, axis=0)
    result = follow(g, Proxy(*grid(48)), move)
    assert np.linalg.norm(result.means_world - move(g.means_world), axis=1).max() < 2e-3
    assert np.median(covariance_errors(result, moved_covariances(g, derivative))) < 0.01


def test_twist_and_bend_of_a_cage_stay_near_the_exact_maps(make_scene: Make) -> None:
    g = make_scene(300, spread=0.8)
    proxy = Proxy(*cube(6))
    for move, bound in ((twist(0.5)[0], 0.05), (bend(0.3)[0], 0.12)):
        result = follow(g, proxy, move, method="mvc")
        assert np.linalg.norm(result.means_world - move(g.means_world), axis=1).max() < bound


@pytest.mark.parametrize("method", ["nearest", "mvc"])
def test_proxy_deformation_is_continuous(method: str) -> None:
    random = np.random.default_rng(0)
    vertices, triangles = cube(4, 1.0) if method == "mvc" else grid(10)
    crumpled = vertices + 0.15 * random.standard_normal(vertices.shape)
    start = random.uniform(-0.9, 0.9, (4000, 3)) * [1, 1, 0.9 if method == "mvc" else 0.15]
    step = 1e-5 * random.standard_normal((4000, 3))
    pairs = np.stack([start, start + step], axis=1).repeat(4, axis=1)
    moved = bind_corners(Proxy(vertices, triangles), pairs, method, None).deform(crumpled)
    apart = np.linalg.norm(moved[:, 0] - moved[:, 4], axis=1) / np.linalg.norm(step, axis=1)
    assert apart.max() < 15.0  # a tear of one thousandth of a cell would give 20


@pytest.mark.parametrize("method", ["nearest", "mvc"])
def test_proxy_undeformed_leaves_scene_unchanged(make_scene: Make, method: str) -> None:
    g = make_scene(100)
    result = follow(g, Proxy(*cube(3)), lambda p: p, method=method)
    np.testing.assert_allclose(result.means_world, g.means_world, atol=1e-6)
    assert covariance_errors(result, covariances(g)).max() < 1e-5


def test_proxy_leaves_distant_gaussians_unchanged(make_scene: Make) -> None:
    g = make_scene(400, spread=3.0)
    far = np.abs(g.means_world).max(axis=1) > 2.2
    near = np.abs(g.means_world).max(axis=1) < 1.0
    assert far.sum() > 50 and near.sum() > 5
    for method, reach in (("mvc", None), ("mvc", 0.2), ("nearest", 0.2)):
        corners = deformation_corners(g)
        binding = bind_corners(Proxy(*cube(4)), corners, method, reach)
        assert not binding.moving_mask[far].any()
        result, report = deform_to(g, corners, binding.deform(cube(4)[0] + np.array([0, 0, 1.0])))
        assert_same(result.select(far), g.select(far))
        assert report.unmoved >= far.sum()
        if method == "mvc":
            np.testing.assert_allclose(
                result.means_world[near], g.means_world[near] + np.float32([0, 0, 1]), atol=1e-6
            )


def test_coordinates_at_corners_on_faces_and_when_not_kept(monkeypatch) -> None:
    vertices, triangles = cube(2)
    centre = vertices[triangles[0]].mean(axis=0)
    points = np.stack([vertices[3], centre, vertices[triangles[0][:2]].mean(axis=0), np.full(3, 0.1)])
    corners = points[:, None].repeat(8, axis=1)
    shifted = vertices + np.random.default_rng(0).standard_normal(vertices.shape)
    kept = MeanValueBinding(Proxy(vertices, triangles), corners, 0.5).deform(shifted)
    np.testing.assert_allclose(kept[0, 0], shifted[3], atol=1e-9)
    np.testing.assert_allclose(kept[1, 0], shifted[triangles[0]].mean(axis=0), atol=1e-9)
    np.testing.assert_allclose(kept[2, 0], shifted[triangles[0][:2]].mean(axis=0), atol=1e-6)
    monkeypatch.setattr("octasplat.engine.edit.proxy.MAX_CACHE_BYTES", 0)
    np.testing.assert_allclose(
        MeanValueBinding(Proxy(vertices, triangles), corners, 0.5).deform(shifted), kept, atol=1e-12
    )


def test_open_cages_and_other_meshes_are_refused(make_scene: Make) -> None:
    vertices, triangles = cube(2)
    corners = deformation_corners(make_scene(5))
    with pytest.raises(SceneFileError, match="not closed"):
        bind_corners(Proxy(vertices, triangles[1:]), corners, "mvc")
    with pytest.raises(SceneFileError, match="the same mesh"):
        bind_corners(Proxy(vertices, triangles), corners, "mvc").deform(vertices[1:])
    with pytest.raises(SceneFileError, match="no triangle"):
        Proxy(vertices, triangles[:0])


def test_proxy_accepts_arbitrary_map(make_scene: Make) -> None:
    g = make_scene(200, size=0.02)
    move, derivative = twist(0.8)
    seen = []

    def engine(corners: np.ndarray) -> np.ndarray:
        seen.append(corners.shape)
        return move(corners)

    result, report = deform(g, engine)
    assert seen == [(200, 8, 3)] and report.moved == 200
    np.testing.assert_allclose(result.means_world, move(g.means_world), atol=3e-3)
    assert np.median(covariance_errors(result, moved_covariances(g, derivative))) < 2e-3
    assert report.residual_max < 0.2
    same, report = deform(g, lambda corners: corners.copy())
    assert_same(same, g)
    assert report.unmoved == 200


def test_coincident_vertices_keep_gaussians_finite(make_scene: Make) -> None:
    g = make_scene(20)
    result, report = deform(g, lambda corners: np.zeros_like(corners) + 3.0)
    assert report.collapsed == 20 and result.is_finite()
    np.testing.assert_array_equal(result.means_world, np.full((20, 3), 3, np.float32))
    with pytest.raises(ValueError, match="not finite"):
        deform(g, lambda corners: corners * np.nan)


def colors_seen(g: FlatGaussians, directions: np.ndarray) -> np.ndarray:
    """Of each Gaussian along each of the ray directions, world frame."""
    return np.einsum("sk,nkc->nsc", sh_basis(directions, g.sh_degree), g.sh.astype(np.float64))


def ball(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed surface that is no mirror image of itself."""
    vertices, triangles = cube(cells)
    round_ones = 1.2 * vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return round_ones + 0.2 * round_ones[:, [1, 2, 0]] ** 2, triangles


def bowl(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """An open surface that is far from a plane."""
    vertices, triangles = grid(cells)
    vertices[:, 2] = 0.5 * (vertices[:, :2] ** 2).sum(axis=1)
    return vertices, triangles


REFLECTION = np.eye(3) - 2 * np.outer([0.6, 0.0, 0.8], [0.6, 0.0, 0.8])
MIRRORS = {
    "reflection": REFLECTION,
    "reflection, turn and scale": 0.7 * random_turn(4) @ np.diag([1.0, -1.0, 1.0]),
    "inversion": -np.eye(3),
}


@pytest.mark.parametrize("linear", MIRRORS.values(), ids=MIRRORS.keys())
@pytest.mark.parametrize(("method", "proxy"), [("mvc", ball(3)), ("nearest", ball(4)), ("nearest", bowl(8))])
def test_proxy_mirrored_mesh_mirrors_scene(make_scene: Make, linear, method: str, proxy) -> None:
    g = make_scene(200, spread=0.4)
    result = follow(g, Proxy(*proxy), lambda p: p @ linear.T + [1, 2, 3], method=method, reach_world=np.inf)
    scale = np.abs(np.linalg.det(linear)) ** (1 / 3)
    np.testing.assert_allclose(result.means_world, g.means_world @ linear.T + [1, 2, 3], atol=2e-6)
    assert covariance_errors(result, linear @ covariances(g) @ linear.T).max() < 1e-4
    # The normal is the image of the old one, up to its sign, and the frame is a rotation.
    np.testing.assert_allclose(np.linalg.det(result.rotations), 1.0, atol=1e-5)
    normals = np.einsum("ij,nj->ni", linear / scale, g.rotations[:, :, 0])
    np.testing.assert_allclose(np.sum(normals * result.rotations[:, :, 0], axis=1), 1.0, atol=1e-5)
    # Seen along the mirrored ray, each Gaussian has the color that it had.
    directions = np.random.default_rng(2).standard_normal((20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = colors_seen(result, directions @ (linear / scale).T)
    np.testing.assert_allclose(seen, colors_seen(g, directions), atol=2e-4)


def test_proxy_mirrored_cage_reports_gaussians(make_scene: Make) -> None:
    g = make_scene(200, spread=2.0)
    corners = deformation_corners(g)
    binding = bind_corners(Proxy(*cube(3)), corners, "mvc")
    vertices = cube(3)[0] * [-1, 1, 1]
    result, report = deform_to(g, corners, binding.deform(vertices), binding.mirrored_mask(vertices))
    inside = np.abs(g.means_world).max(axis=1) < 1.2
    assert report.mirrored == report.moved == inside.sum()
    assert_same(result.select(~inside), g.select(~inside))


def test_proxy_turned_over_mesh_is_not_mirrored(make_scene: Make) -> None:
    pushed_through = bowl(8)[0] * [1, 1, -1] + 0.1 * np.sin(3 * bowl(8)[0])[:, [1, 0, 2]]
    turned_over = grid(8)[0] * [-1, 1, 1]
    corners = deformation_corners(make_scene(20))
    for (vertices, triangles), moved in ((bowl(8), pushed_through), (grid(8), turned_over)):
        assert not bind_corners(Proxy(vertices, triangles), corners).mirrored_mask(moved).any()
    told = bind_corners(Proxy(*grid(8), mirrored_override=True), corners, reach_world=np.inf)
    assert told.mirrored_mask(turned_over).all()
    np.testing.assert_allclose(told.deform(turned_over), corners * [-1, 1, 1], atol=1e-9)


@pytest.mark.parametrize("method", ["nearest", "mvc"])
def test_proxy_uncached_weights_give_same_frames(make_scene: Make, monkeypatch, method: str) -> None:
    corners = deformation_corners(make_scene(300, spread=1.5))
    moved = twist(0.5)[0](cube(3)[0])
    kept = bind_corners(Proxy(*cube(3)), corners, method, 0.3).deform(moved)
    monkeypatch.setattr("octasplat.engine.edit.proxy.MAX_CACHE_BYTES", 0)
    again = bind_corners(Proxy(*cube(3)), corners, method, 0.3)
    np.testing.assert_array_equal(again.deform(moved), kept)
    np.testing.assert_array_equal(again.deform(moved), kept)


@pytest.mark.parametrize("size", [30.0, 300.0, 3e4])
def test_proxy_nearest_triangle_with_uneven_density_is_found(size: float) -> None:
    sphere, facets = ball(24)
    radius, centre = 0.5, np.array([0.0, 0.0, 4.5])
    sphere = centre + radius * sphere / np.linalg.norm(sphere, axis=1, keepdims=True)
    floor = size * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    triangles = np.concatenate([facets, np.array([[0, 1, 2], [0, 2, 3]]) + len(sphere)])
    near = NearTriangles(np.concatenate([sphere, floor])[triangles].astype(np.float64))
    random = np.random.default_rng(2)
    points = random.uniform([-4, -4, 0.05], [4, 4, 6], (20_000, 3))
    to_ball = np.linalg.norm(points - centre, axis=1) - radius
    chosen, weights, distances = near.query(points)
    np.testing.assert_allclose(distances, np.minimum(np.abs(to_ball), points[:, 2]), atol=0.01)
    on_floor = np.where(chosen >= len(facets), weights, 0.0).sum(axis=1)
    sure = np.abs(np.abs(to_ball) - points[:, 2]) > 0.2  # beyond where both are blended
    np.testing.assert_allclose(on_floor[sure], (np.abs(to_ball) > points[:, 2])[sure], atol=1e-6)


def test_searches_take_no_more_threads_than_kernels_may(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(2)
    points, corners = random.random((40, 3)), random.random((30, 3, 3))
    taken: list[int] = []
    query = KDTree.query

    def watched(tree: KDTree, *args: object, workers: int = 1, **named: object) -> object:
        taken.append(workers)
        return query(tree, *args, workers=workers, **named)

    monkeypatch.setattr(KDTree, "query", watched)
    before = threads_in_use()
    try:
        use_threads(1)
        NearTriangles(corners).query(points)
        neighbour_rotations(points, points, np.arange(40))
        interpolate_motion(
            points,
            points,
            points,
            lambda rows: np.zeros((len(rows), 3, 3)),
            np.ones(40, bool),
            points[:3] + 1,
        )
    finally:
        use_threads(before)
    assert len(taken) >= 4 and set(taken) == {1}
