"""Meshes of other scenes are refused; edits that change most of a scene are not."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.edit.mesh_to_gaussians import recover_gaussians
from octasplat.engine.edit.selection import in_mesh
from octasplat.engine.files import ExportOptions, ImportedMesh, export_scene, read_mesh
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import SIDES
from tests.support.edit_scenes import assert_same, covariance_errors, covariances

Make = Callable[..., FlatGaussians]
NAMES = ("mesh.ply", "scene.obj", "scene.glb")


def exported(gaussians: FlatGaussians, path: Path) -> ImportedMesh:
    export_scene(gaussians, path, ExportOptions())
    return read_mesh(path)


def as_saved_by_an_editor(mesh: ImportedMesh) -> ImportedMesh:
    """The mesh without what editors drop of a file: comments and extras."""
    return replace(mesh, q=None, min_opacity=None, scene_size=None)


def only(mesh: ImportedMesh, kept: np.ndarray) -> ImportedMesh:
    """The mesh of the octagons of some Gaussians alone."""
    vertices = kept[mesh.gid.astype(int)]
    number = np.cumsum(vertices) - 1
    attributes = ("uv", "gid", "corner", "radius")
    found = {name: getattr(mesh, name) for name in attributes if getattr(mesh, name) is not None}
    return replace(
        mesh,
        vertices=mesh.vertices[vertices],
        triangles=number[mesh.triangles[vertices[mesh.triangles].all(axis=1)]],
        **{name: values[vertices] for name, values in found.items()},
    )


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("count", [60, 2000])
@pytest.mark.parametrize("spread", [1.0, 30.0])
def test_mesh_of_another_scene_is_refused(
    make_scene: Make, tmp_path: Path, name: str, count: int, spread: float
) -> None:
    scene = make_scene(2000, seed=1)
    path = tmp_path / name
    other = exported(make_scene(count, seed=2, spread=spread), path)
    for mesh in (other, as_saved_by_an_editor(other)):
        with pytest.raises(SceneFileError, match=rf"{name}.*looks like the mesh of another scene; name the"):
            recover_gaussians(scene, mesh, path)
        with pytest.raises(SceneFileError, match="looks like the mesh of another scene"):
            in_mesh(scene, mesh, path)


@pytest.mark.parametrize("left_out", [("radius",), ("radius", "uv")])
def test_mesh_of_another_scene_is_known_without_its_radii(
    make_scene: Make, tmp_path: Path, left_out: tuple[str, ...]
) -> None:
    scene, path = make_scene(1000, seed=1), tmp_path / "mesh.ply"
    other = as_saved_by_an_editor(exported(make_scene(500, seed=2), path))
    with pytest.raises(SceneFileError, match="looks like the mesh of another scene"):
        recover_gaussians(scene, replace(other, **dict.fromkeys(left_out)), path)
    own = replace(as_saved_by_an_editor(exported(scene, path)), **dict.fromkeys(left_out))
    _, report = recover_gaussians(scene, replace(own, vertices=own.vertices * 3 + 10), path)
    assert report.moved == 1000


def test_mesh_with_more_numbers_or_of_a_scene_of_another_size_is_refused_by_name(
    make_scene: Make, tmp_path: Path
) -> None:
    path = tmp_path / "mesh.ply"
    mesh = exported(make_scene(300), path)
    scene = make_scene(200)
    with pytest.raises(
        SceneFileError, match="a scene of 300 Gaussians, but the scene has 200; it looks like"
    ):
        recover_gaussians(scene, mesh, path)
    with pytest.raises(SceneFileError, match="numbers a Gaussian 299, but the scene has 200; it looks like"):
        recover_gaussians(scene, as_saved_by_an_editor(mesh), path)


@pytest.mark.parametrize("name", ["mesh.ply", "scene.glb"])
def test_scene_of_which_most_was_deleted_comes_back(make_scene: Make, tmp_path: Path, name: str) -> None:
    scene, path = make_scene(1000), tmp_path / name
    whole = as_saved_by_an_editor(exported(scene, path))
    kept = np.arange(1000) % 10 == 3
    mesh = only(whole, kept)
    result, report = recover_gaussians(scene, mesh, path)
    assert_same(result, scene.select(kept))
    assert (report.unmoved, report.deleted) == (100, 900)
    np.testing.assert_array_equal(in_mesh(scene, mesh, path), kept)
    # The same, and what is left is moved.
    _, report = recover_gaussians(scene, replace(mesh, vertices=2.0 * mesh.vertices + 1.0), path)
    assert (report.moved, report.deleted) == (100, 900)
    one, _ = recover_gaussians(scene, only(whole, np.arange(1000) == 7), path)
    assert_same(one, scene.select(np.arange(1000) == 7))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("scale", "shift"), [(1.0, 2.0), (2.0, 0.0), (0.01, 5.0)])
def test_scene_moved_and_scaled_as_a_whole_comes_back(
    make_scene: Make, tmp_path: Path, name: str, scale: float, shift: float
) -> None:
    scene, path = make_scene(500), tmp_path / name
    mesh = as_saved_by_an_editor(exported(scene, path))
    moved = replace(mesh, vertices=mesh.vertices * scale + [shift, 0.0, 0.0])
    result, report = recover_gaussians(scene, moved, path)
    assert report.moved == 500
    expected = scene.means_world * scale + np.float32([shift, 0, 0])
    np.testing.assert_allclose(result.means_world, expected, atol=1e-4 * max(scale, 1.0))
    if scale >= 1.0:
        assert covariance_errors(result, scale**2 * covariances(scene)).max() < 1e-2


def test_scene_scattered_by_a_simulation_comes_back(make_scene: Make, tmp_path: Path) -> None:
    scene, path = make_scene(500), tmp_path / "mesh.ply"
    mesh = exported(scene, path)
    shifts = np.random.default_rng(0).uniform(-20, 20, (500, 3))
    _, report = recover_gaussians(
        scene, replace(mesh, vertices=mesh.vertices + np.repeat(shifts, SIDES, axis=0)), path
    )
    assert report.moved == 500
