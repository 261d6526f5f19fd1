"""Meshes through Blender itself and back."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.edit.edit_options import MeshToGaussiansOptions
from octasplat.engine.edit.mesh_to_gaussians import recover_gaussians
from octasplat.engine.files import export_scene, read_mesh
from octasplat.engine.gaussians.model import FlatGaussians
from tests.support.daily import some_daily
from tests.support.edit_scenes import assert_same, covariance_errors, moved_covariances, twist

pytestmark = pytest.mark.tools
Make = Callable[..., FlatGaussians]
ROUTES = ("mesh.ply", "mesh.obj", "mesh.glb")


@pytest.mark.parametrize("name", some_daily(ROUTES, {"mesh.glb"}))
def test_edit_unchanged_blender_export_gives_same_scene(
    blender, make_scene: Make, tmp_path: Path, name: str
) -> None:
    g = make_scene(600)  # two chunks, so that the order in a GLB is not that of the scene
    export_scene(g, tmp_path / name, format="mesh-ply" if name.endswith("ply") else None)
    for target in ("out.ply", "out.obj", "out.glb"):
        blender(tmp_path / name, tmp_path / target, "none")
        if name[-3:] != target[-3:] and (
            target.endswith("glb") or (name.endswith("glb") and target.endswith("obj"))
        ):
            # Blender splits vertices for GLB and leaves out attributes whose names have no underscore; an OBJ
            # has no attributes at all.
            with pytest.raises(SceneFileError, match="cannot be matched"):
                recover_gaussians(g, read_mesh(tmp_path / target), tmp_path / target)
            continue
        result, report = recover_gaussians(g, read_mesh(tmp_path / target), tmp_path / target)
        assert_same(result, g)
        assert (report.axes != report.axes_usual) == (name[-3:] != target[-3:])


@pytest.mark.parametrize("name", ROUTES[:2])  # each chunk of a GLB is an object that twists by itself
def test_edit_blender_twist_matches_exact_map(blender, make_scene: Make, tmp_path: Path, name: str) -> None:
    """SimpleDeform turns by 1 radian along the object's height; the exact map is fitted to the vertices."""
    g = make_scene(500)
    export_scene(g, tmp_path / name, format="mesh-ply" if name.endswith("ply") else None)
    target = tmp_path / f"out{Path(name).suffix}"
    blender(tmp_path / name, target, "twist")
    before, after = read_mesh(tmp_path / name).vertices, read_mesh(target).vertices
    axis = int(np.argmin(np.abs(after - before).max(axis=0)))
    x, y = (axis + 1) % 3, (axis + 2) % 3
    angles = np.angle((after[:, x] + 1j * after[:, y]) / (before[:, x] + 1j * before[:, y]))
    rate, phase = np.polyfit(before[:, axis], np.unwrap(angles), 1)
    exact, derivative = twist(rate, axis)
    turned_back = twist_by(-phase, axis, after)
    np.testing.assert_allclose(exact(before), turned_back, atol=5e-6)

    expected = moved_covariances(g, derivative)
    back = twist_by(-phase, axis, np.eye(3)).T
    expected = back.T @ expected @ back
    errors, centres = {}, {}
    for method in ("least-squares", "three-point"):
        options = MeshToGaussiansOptions.model_validate({"method": method, "axes": "x0"})
        result, report = recover_gaussians(g, read_mesh(target), target, options)
        errors[method] = covariance_errors(result, expected)
        means = twist_by(phase, axis, exact(g.means_world))
        centres[method] = np.linalg.norm(result.means_world - means, axis=1) / g.scales.max(axis=1)
        assert report.moved == 500 and report.crumpled == report.flipped == 0
    assert report.residual_max < 0.3
    assert np.median(errors["least-squares"]) < 0.02 and errors["least-squares"].max() < 0.15
    assert np.median(errors["three-point"]) > 5 * np.median(errors["least-squares"])
    assert errors["three-point"].max() > 0.2
    assert centres["least-squares"].max() < 0.5


def twist_by(angle: float, axis: int, points: np.ndarray) -> np.ndarray:
    """Points turned about an axis."""
    x, y = (axis + 1) % 3, (axis + 2) % 3
    moved = points.astype(np.float64)
    moved[..., x] = np.cos(angle) * points[..., x] - np.sin(angle) * points[..., y]
    moved[..., y] = np.sin(angle) * points[..., x] + np.cos(angle) * points[..., y]
    return moved


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["mesh.ply", "mesh.glb"])
def test_cutting_copying_and_welding(blender, make_scene: Make, tmp_path: Path, name: str) -> None:
    g = make_scene(300)
    source = tmp_path / name
    export_scene(g, source, format="mesh-ply" if name.endswith("ply") else None)
    reports = {}
    for edit in ("delete", "duplicate", "weld"):
        target = tmp_path / f"{edit}{source.suffix}"
        blender(source, target, edit)
        result, reports[edit] = recover_gaussians(g, read_mesh(target), target)
        assert reports[edit].moved == 0
        originals = result.select(np.arange(len(result) - reports[edit].copies))
        if edit != "delete":
            assert_same(originals, g)
    left = g.means_world[:, 0] < 0.2  # the cut is at 0.5
    assert reports["delete"].deleted > 20 and reports["delete"].unmoved >= left.sum()
    assert reports["duplicate"].copies > 20
    assert reports["weld"].incomplete > 0
