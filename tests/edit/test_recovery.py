"""Gaussians from edited octagon meshes."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.edit.edit_options import MeshToGaussiansOptions
from octasplat.engine.edit.mesh_to_gaussians import EditReport, recover_gaussians
from octasplat.engine.files import ExportOptions, ImportedMesh, export_scene, read_mesh
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import CHI2_3_99, SIDES
from octasplat.engine.gaussians.spherical_harmonics import sh_basis
from tests.support.edit_scenes import (
    assert_same,
    covariance_errors,
    covariances,
    moved_covariances,
    random_turn,
    twist,
)

Make = Callable[..., FlatGaussians]
PLY = Path("edited.ply")


@pytest.fixture
def exported(tmp_path: Path) -> Callable[..., ImportedMesh]:
    def export(gaussians: FlatGaussians, name: str = "mesh.ply", **options: object) -> ImportedMesh:
        export_scene(gaussians, tmp_path / name, ExportOptions.model_validate(options))
        return read_mesh(tmp_path / name)

    return export


def moved(mesh: ImportedMesh, change: Callable[[np.ndarray], np.ndarray]) -> ImportedMesh:
    """The mesh edited and saved in float32."""
    return replace(mesh, vertices=change(mesh.vertices).astype(np.float32).astype(np.float64))


def without(mesh: ImportedMesh, gone: np.ndarray) -> ImportedMesh:
    """The mesh without some vertices and their triangles."""
    number = np.cumsum(~gone) - 1
    triangles = number[mesh.triangles[~gone[mesh.triangles].any(axis=1)]]

    def rest(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None else values[~gone]

    return replace(
        mesh,
        vertices=mesh.vertices[~gone],
        triangles=triangles,
        **{name: rest(getattr(mesh, name)) for name in ("uv", "gid", "corner", "radius")},
    )


def recover(
    gaussians: FlatGaussians, mesh: ImportedMesh, path: Path = PLY, **options: object
) -> tuple[FlatGaussians, EditReport]:
    return recover_gaussians(gaussians, mesh, path, MeshToGaussiansOptions.model_validate(options))


@pytest.mark.parametrize("name", ["mesh.ply", "scene.obj", "scene.glb"])
def test_recovery_of_unedited_mesh_is_bit_exact(make_scene: Make, exported, name: str) -> None:
    g = make_scene(400)
    g.opacity_logits[:7] = -9.0  # too faint for an octagon
    result, report = recover(g, exported(g, name), Path(name))
    assert_same(result, g)
    assert (report.unmoved, report.moved, report.carried, report.deleted) == (393, 0, 7, 0)
    assert report.matched_by == ("order" if name.endswith("obj") else "ids")


@pytest.mark.parametrize("name", ["mesh.ply", "scene.obj", "scene.glb"])
@pytest.mark.parametrize(
    "options",
    [
        {"q": 4.0},
        {"min_opacity": 0.7},
        {"q": 6.5, "min_opacity": 0.5},
        {"opaque": True},
        {"opaque": True, "q": 6.5},
    ],
)
def test_export_options_are_found_out(make_scene: Make, exported, name: str, options: dict) -> None:
    g = make_scene(200)
    mesh = exported(g, name, **options)
    for known in (mesh, replace(mesh, q=None, alpha_cutoff=None)):
        result, report = recover(g, known, Path(name))
        assert_same(result, g)
        assert report.deleted == 0
        assert report.q == pytest.approx(options.get("q", 9.21034), rel=1e-6)


def test_recovery_infers_q_from_texture(make_scene: Make, exported) -> None:
    g = make_scene(200)
    mesh = replace(exported(g, "scene.glb", q=5.0), q=None, radius=None)
    assert recover(g, mesh, Path("scene.glb"))[1].q == pytest.approx(5.0)


@pytest.mark.parametrize("is_opaque", [False, True])
@pytest.mark.parametrize("q", [CHI2_3_99, 16.0])
def test_q_of_a_mesh_without_ids_follows_from_its_texture(
    make_scene: Make, exported, is_opaque: bool, q: float
) -> None:
    g = make_scene(400)
    if is_opaque:
        g.opacity_logits[:] = np.random.default_rng(0).uniform(3.0, 6.0, 400)
    # an OBJ that an editor saved has no comments
    mesh = replace(exported(g, "scene.obj", q=q), q=None, min_opacity=None, scene_size=None)
    result, report = recover(g, mesh, Path("scene.obj"))
    assert report.q == q and report.moved == 0
    assert_same(result, g)


def test_recovery_changes_moved_octagons_only(make_scene: Make, exported) -> None:
    g = make_scene(200)
    mesh = exported(g)
    chosen = g.means_world[:, 0] > 0
    shift = np.where(chosen[mesh.gid.astype(int)], 0.5, 0.0)[:, None] * [0.0, 1.0, 0.0]
    result, report = recover(g, moved(mesh, lambda points: points + shift))
    assert_same(result.select(~chosen), g.select(~chosen))
    assert report.moved == chosen.sum() and report.unmoved == (~chosen).sum()
    np.testing.assert_allclose(
        result.means_world[chosen], g.means_world[chosen] + np.float32([0, 0.5, 0]), atol=3e-7
    )
    assert covariance_errors(result, covariances(g)).max() < 1e-4
    np.testing.assert_allclose(result.sh, g.sh, atol=2e-4)


def test_recovery_partial_octagons_warn_and_snap(make_scene: Make, exported) -> None:
    g = make_scene(400)
    mesh = exported(g)
    old = mesh.vertices.reshape(-1, SIDES, 3)
    inside = old[:, :, 0] > 0  # what a box in the editor takes, corner by corner
    cut = inside.any(axis=1) & ~inside.all(axis=1)
    assert cut.sum() > 5
    lifted = old + np.where(inside[:, :, None], [0.0, 3.0, 0.0], 0.0)
    edited = moved(mesh, lambda _: lifted.reshape(-1, 3))
    _, report = recover(g, edited)
    assert report.partial == cut.sum() and report.snapped == 0
    result, report = recover(g, edited, whole_octagons=True)
    assert report.partial == report.snapped == cut.sum() and report.crumpled == 0
    # Everything is where it was or three units up, in its own shape.
    gids = mesh.gid.astype(int).reshape(-1, SIDES)[:, 0]
    up = np.zeros(len(g), bool)
    up[gids] = 2 * inside.sum(axis=1) >= SIDES
    np.testing.assert_allclose(
        result.means_world, g.means_world + np.where(up[:, None], [0, 3, 0], 0), atol=2e-6
    )
    assert covariance_errors(result, covariances(g)).max() < 1e-3
    assert_same(result.select(~up), g.select(~up))


def test_recovery_rotated_part_is_not_mirrored(make_scene: Make, exported) -> None:
    g = make_scene(600)
    mesh = exported(g)
    middle = np.array([0.5, 0.0, 0.0])
    for seed in range(4):
        turn = random_turn(seed)
        chosen = np.linalg.norm(g.means_world - middle, axis=1) < 0.6
        assert 10 < chosen.sum() < 500
        mine = chosen[mesh.gid.astype(int)][:, None]
        turned = (mesh.vertices - middle) @ turn.T + middle + [0, 2, 0]
        edited = replace(mesh, vertices=np.where(mine, turned, mesh.vertices))
        _, report = recover(g, edited, axes="x0")
        assert (report.mirrored, report.flipped, report.crumpled) == (0, 0, 0), seed


def test_rotation_and_uniform_scale(make_scene: Make, exported) -> None:
    g = make_scene(300)
    turn, shift = random_turn(3), np.array([0.4, -1.0, 2.0])
    result, report = recover(g, moved(exported(g), lambda p: 1.7 * p @ turn.T + shift), axes="x0")
    assert report.moved == 300 and report.flipped == report.mirrored == report.crumpled == 0
    np.testing.assert_allclose(result.means_world, 1.7 * g.means_world @ turn.T + shift, atol=1e-6)
    assert covariance_errors(result, 1.7**2 * turn @ covariances(g) @ turn.T).max() < 1e-4
    d = random_turn(5)
    seen = np.einsum("sk,nkc->nsc", sh_basis(d @ turn.T, 3), result.sh)
    np.testing.assert_allclose(seen, np.einsum("sk,nkc->nsc", sh_basis(d, 3), g.sh), atol=2e-4)
    np.testing.assert_array_equal(result.opacity_logits, g.opacity_logits)


def test_shear_and_stretch_are_exact_by_least_squares_and_not_by_three_points(
    make_scene: Make, exported
) -> None:
    g = make_scene(300)
    m = np.array([[1.3, 0.6, 0.0], [0.0, 0.8, 0.2], [0.3, 0.0, 1.0]])
    mesh = moved(exported(g), lambda p: p @ m.T)
    expected = m @ covariances(g) @ m.T
    result, report = recover(g, mesh)
    assert covariance_errors(result, expected).max() < 1e-4
    assert report.residual_max < 1e-4
    three, _ = recover(g, mesh, method="three-point")
    errors = covariance_errors(three, expected)
    assert np.median(errors) > 0.1 and errors.max() > 0.4
    np.testing.assert_allclose(three.means_world, result.means_world, atol=1e-6)


def test_twist_covariance_is_least_squares(make_scene: Make, exported) -> None:
    g = make_scene(500)
    move, derivative = twist(1.0)
    mesh = moved(exported(g), move)
    expected = moved_covariances(g, derivative)
    errors = {
        method: covariance_errors(recover(g, mesh, method=method)[0], expected)
        for method in ("least-squares", "three-point")
    }
    assert np.median(errors["least-squares"]) < 0.01 and errors["least-squares"].max() < 0.1
    assert np.median(errors["three-point"]) > 0.05 and errors["three-point"].max() > 0.3


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_recovery_of_mirrored_mesh_mirrors_harmonics(make_scene: Make, exported, axis: int) -> None:
    g = make_scene(300)
    mirror = np.eye(3)
    mirror[axis, axis] = -1.0
    result, report = recover(g, moved(exported(g), lambda p: p @ mirror), axes="x0")
    assert report.mirrored == 300 and report.flipped == 0
    assert covariance_errors(result, mirror @ covariances(g) @ mirror).max() < 1e-4
    d = random_turn(5)
    seen = np.einsum("sk,nkc->nsc", sh_basis(d @ mirror, 3), result.sh)
    np.testing.assert_allclose(seen, np.einsum("sk,nkc->nsc", sh_basis(d, 3), g.sh), atol=2e-4)


@pytest.mark.parametrize("damaged", ["repair", "drop"])
def test_recovery_octagons_with_missing_corners(make_scene: Make, exported, damaged: str) -> None:
    g = make_scene(100)
    mesh = exported(g)
    gone = np.zeros(len(mesh), dtype=bool)
    gone[0 * SIDES + np.array([1, 4, 6])] = True
    gone[1 * SIDES + np.array([0, 1, 2, 3, 4])] = True  # three left
    gone[2 * SIDES + np.arange(6)] = True  # two left
    gone[3 * SIDES + np.arange(8)] = True  # none
    m = np.array([[1.1, 0.2, 0.0], [0.0, 0.9, 0.1], [0.0, 0.3, 1.2]])
    edited = moved(without(mesh, gone), lambda p: p @ m.T)
    result, report = recover(g, edited, damaged=damaged)
    assert (report.incomplete, report.deleted) == (3, 1)
    kept = np.delete(np.arange(100), [3] if damaged == "repair" else [0, 1, 2, 3])
    assert len(result) == len(kept) and report.dropped == (0 if damaged == "repair" else 3)
    errors = covariance_errors(result, (m @ covariances(g) @ m.T)[kept])
    sound = kept != 2
    assert errors[sound].max() < 1e-3
    np.testing.assert_allclose(result.means_world[sound], (g.means_world @ m.T)[kept][sound], atol=1e-5)
    if damaged == "repair":  # moved as its neighbours, which the normal's stretch is only guessed from
        assert np.linalg.norm(result.means_world[2] - m @ g.means_world[2]) < 0.1


def test_recovery_partial_octagon_keeps_gaussian(make_scene: Make, exported) -> None:
    g = make_scene(50)
    mesh = exported(g)
    gone = np.arange(len(mesh)) % SIDES >= np.where(mesh.gid % 2 == 0, 8, 1)
    result, report = recover(g, without(mesh, gone))
    assert_same(result, g)
    assert report.incomplete == 25 and report.moved == 0


def test_recovery_deletes_faint_neighbours_of_deleted_octagons(make_scene: Make, exported) -> None:
    g = make_scene(200)
    g.opacity_logits[:20] = -9.0
    mesh = exported(g)
    right = g.means_world[:, 0] > 0
    result, report = recover(g, without(mesh, right[mesh.gid.astype(int)]))
    assert abs(report.deleted - right[20:].sum()) <= 1  # the faintest one might not have been exported
    assert report.carried + report.orphaned + report.deleted == 20 + right[20:].sum()
    assert report.carried > 0 and report.orphaned > 0
    assert report.unmoved == (~right[20:]).sum()
    assert len(result) == report.unmoved + report.carried
    assert result.means_world[result.opacities < 0.01][:, 0].max(initial=-1) < 0.3


def test_recovery_moves_faint_gaussians_with_neighbours(make_scene: Make, exported) -> None:
    g = make_scene(600, spread=0.5)
    g.opacity_logits[:50] = -9.0
    turn = random_turn(8)
    result, report = recover(g, moved(exported(g), lambda p: 1.2 * p @ turn.T), axes="x0")
    assert report.carried == 50
    np.testing.assert_allclose(result.means_world, 1.2 * g.means_world @ turn.T, atol=5e-5)
    assert covariance_errors(result, 1.44 * turn @ covariances(g) @ turn.T).max() < 1e-3


def test_duplicated_octagons_become_gaussians(make_scene: Make, exported) -> None:
    g = make_scene(100)
    mesh = exported(g)
    half = mesh.gid < 50
    copy = without(mesh, ~half)
    both = replace(
        mesh,
        vertices=np.concatenate([copy.vertices + np.array([0, 0, 3.0]), mesh.vertices]),
        triangles=np.concatenate([copy.triangles, mesh.triangles + len(copy)]),
        **{
            name: np.concatenate([getattr(copy, name), getattr(mesh, name)])
            for name in ("uv", "gid", "corner", "radius")
        },
    )
    result, report = recover(g, both)
    assert report.copies == 50 and report.unmoved == 100 and len(result) == 150
    assert_same(result.select(np.arange(100)), g)
    np.testing.assert_allclose(
        result.means_world[100:], g.means_world[:50] + np.float32([0, 0, 3]), atol=1e-6
    )
    assert covariance_errors(result.select(np.arange(100, 150)), covariances(g)[:50]).max() < 1e-3


def test_vertices_of_other_objects_and_blended_ids_are_passed_over(make_scene: Make, exported) -> None:
    g = make_scene(60)
    mesh = exported(g)
    strange = np.array([[9.0, 9, 9], [8, 8, 8], [7, 7, 7], [0, 0, 0]])
    joined = replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, strange]),
        triangles=np.concatenate([mesh.triangles, len(mesh) + np.array([[0, 1, 2]])]),
        uv=None,
        radius=None,
        gid=np.concatenate([mesh.gid, np.float32([0, 0, 0, 12.5])]),  # a joined object has zeros
        corner=np.concatenate([mesh.corner, np.float32([0, 0, 0, 3])]),
    )
    result, report = recover(g, joined)
    assert_same(result, g)
    assert report.foreign_vertices >= 1 and report.copies == 0


def test_crumpled_octagons_follow_their_surroundings_or_are_dropped(make_scene: Make, exported) -> None:
    g = make_scene(300, spread=0.4)
    mesh = exported(g)
    points = mesh.vertices.reshape(-1, SIDES, 3).copy()
    points[0] = points[0, 3]  # a point
    points[1] = points[1, :1] + np.linspace(0, 1, SIDES)[:, None] * [0.1, 0.1, 0.0]  # a line
    points[2, [1, 5]] = points[2, [5, 1]]  # folded
    crumpled = replace(mesh, vertices=points.reshape(-1, 3) + np.array([1.0, 0, 0]))
    result, report = recover(g, crumpled)
    assert report.crumpled == 3 and len(result) == 300
    np.testing.assert_allclose(result.means_world, g.means_world + np.float32([1, 0, 0]), atol=1e-3)
    assert covariance_errors(result, covariances(g)).max() < 1e-2
    fewer, report = recover(g, crumpled, damaged="drop")
    assert report.dropped == 3 and len(fewer) == 297


def test_flipped_octagons_are_restored(make_scene: Make, exported) -> None:
    g = make_scene(400, spread=0.5)
    mesh = exported(g)
    turn = random_turn(2)
    points = mesh.vertices.reshape(-1, SIDES, 3).copy()
    flipped = [3, 30, 300]
    points[flipped] = points[flipped][:, (-np.arange(SIDES)) % SIDES]  # the other way round
    edited = replace(mesh, vertices=points.reshape(-1, 3) @ turn.T)
    result, report = recover(g, edited, axes="x0")
    assert report.flipped == 3 and report.crumpled == 0
    normals = np.einsum("ij,nj->ni", turn, g.rotations[:, :, 0])
    assert (np.sum(result.rotations[:, :, 0] * normals, axis=1) > 0.999).all()
    assert len(recover(g, edited, axes="x0", damaged="drop")[0]) == 397


@pytest.mark.parametrize(
    ("written", "came_back", "axes"),
    [
        ("mesh.ply", lambda p: p[:, [0, 2, 1]] * [1, 1, -1], "x90"),  # in as PLY, out as OBJ or GLB
        ("mesh.ply", lambda p: p[:, [0, 2, 1]] * [1, -1, 1], "x270"),
        ("mesh.ply", lambda p: p * [1, -1, -1], "x180"),
        ("mesh.ply", lambda p: p, "x0"),
    ],
)
def test_axes_of_mixed_routes_are_found(make_scene: Make, exported, written, came_back, axes: str) -> None:
    g = make_scene(200)
    mesh = exported(g, written)
    result, report = recover(g, replace(mesh, vertices=came_back(mesh.vertices)))
    assert report.axes == axes and report.axes_usual == "x0"
    assert_same(result, g)
    move, derivative = twist(0.7)
    twisted, report = recover(g, moved(mesh, lambda p: came_back(move(p))))
    assert report.axes == axes
    assert np.median(covariance_errors(twisted, moved_covariances(g, derivative))) < 0.01


def test_recovery_axes_option_is_used(make_scene: Make, exported) -> None:
    g = make_scene(200)
    turned = moved(exported(g), lambda p: p * [1, -1, -1])  # this time by the user
    result, report = recover(g, turned, axes="x0")
    assert report.axes == "x0" and report.moved == 200
    np.testing.assert_allclose(result.means_world, g.means_world * [1, -1, -1], atol=1e-6)


def test_unmatched_mesh_is_refused_with_reason(make_scene: Make, exported) -> None:
    g = make_scene(50)
    mesh = exported(g)
    nameless = replace(mesh, gid=None, corner=None)
    fewer = without(nameless, np.arange(len(mesh)) == 5)
    with pytest.raises(SceneFileError, match=r"edited\.ply.*no ids.*399 of them where 400"):
        recover(g, fewer)
    g.opacity_logits[:3] = g.opacity_logits.min()  # no export leaves out one of three equally faint ones
    with pytest.raises(SceneFileError, match=r"edited\.ply.*no ids.*392 of them where 400"):
        recover(g, without(nameless, np.arange(len(mesh)) < 8))
    mixed = np.random.default_rng(0).permutation(len(mesh))
    shuffled = replace(nameless, vertices=mesh.vertices[mixed], uv=mesh.uv[mixed])
    with pytest.raises(SceneFileError, match="order has changed"):
        recover(g, shuffled)
    with pytest.raises(SceneFileError, match="but the scene has 20"):
        recover(g.select(np.arange(20)), mesh)
    with pytest.raises(SceneFileError, match="none of its vertices"):
        recover(g, replace(mesh, gid=np.full(len(mesh), np.nan, np.float32)))


def test_recovery_keeps_needle_gaussians(make_scene: Make, exported) -> None:
    g = make_scene(100)
    g.log_scales[:, 1] = -14.0
    mesh = exported(g)
    result, _ = recover(g, mesh)
    assert_same(result, g)
    turn = random_turn(4)
    result, _ = recover(g, moved(mesh, lambda p: p @ turn.T), axes="x0")
    assert result.is_finite() and len(result) == 100
    np.testing.assert_allclose(result.means_world, g.means_world @ turn.T, atol=2e-3)
    assert np.median(covariance_errors(result, turn @ covariances(g) @ turn.T)) < 0.01


@pytest.mark.parametrize("name", ["mesh.ply", "scene.glb"])
@pytest.mark.parametrize("least", [0.0, 0.3])
def test_recovery_keeps_min_opacity_deletions(make_scene: Make, exported, name: str, least: float) -> None:
    g = make_scene(400)
    g.opacity_logits[:] = np.linspace(-3.0, 3.0, 400)
    mesh = exported(g, name, min_opacity=least)
    faint = g.opacities[mesh.gid.astype(int)] < 0.5
    result, report = recover(g, without(mesh, faint), Path(name))
    deleted = int(((g.opacities >= least) & (g.opacities < 0.5)).sum())
    assert report.deleted == deleted > 0
    assert (result.opacities >= 0.5).sum() == (g.opacities >= 0.5).sum()
    # What was never exported follows its neighbours: it is carried, or left out with those deleted.
    never = int((g.opacities < least).sum())
    assert report.carried + report.orphaned == never
    assert len(result) == int((g.opacities >= 0.5).sum()) + report.carried


def test_mesh_matched_by_order_has_lost_no_gaussians(make_scene: Make, exported) -> None:
    g = make_scene(400)
    # an OBJ that an editor saved has no comments
    mesh = replace(exported(g, "scene.obj", min_opacity=0.5), q=None, min_opacity=None, scene_size=None)
    result, report = recover(g, mesh, Path("scene.obj"))
    assert report.deleted == 0 and report.carried == (g.opacities < 0.5).sum()
    assert_same(result, g)


def test_recovery_min_opacity_option_restores_faint_gaussians(make_scene: Make, exported) -> None:
    g = make_scene(200)
    mesh = replace(exported(g, min_opacity=0.7), min_opacity=None)
    assert recover(g, mesh)[1].deleted == int((g.opacities < 0.7).sum()) > 0
    result, report = recover(g, mesh, min_opacity=0.7)
    assert_same(result, g)
    assert report.deleted == 0
