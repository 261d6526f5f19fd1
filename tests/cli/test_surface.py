"""``octasplat surface``."""

import re
import signal
import time

import numpy as np
import pytest
import trimesh

from octasplat.engine.dataset.views_file import read_views
from octasplat.engine.files.glb_container import GlbFile
from octasplat.engine.files.glb_place import rotation_of
from octasplat.engine.render.upright import estimate_up

SMALL = ("--resolution", 48, "--depth-side", 48, "--min-component", 0)


def test_run_to_each_format(run, octasplat, tmp_path):
    for name in ("a.glb", "a.ply", "a.obj"):
        result = octasplat("surface", run.output, "-o", tmp_path / name, *SMALL)
        assert result.exit_code == 0, result.output
        assert "triangles" in result.output
        mesh = trimesh.load(tmp_path / name, force="mesh", process=False)
        assert len(mesh.faces) > 100
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.glb", "a.obj", "a.ply"]


def test_surface_all_options_write_textured_obj(run, octasplat, tmp_path):
    result = octasplat(
        "surface", run.output / "scene.ply", "--dataset", run.scene, "-o", tmp_path / "new" / "a.obj", *SMALL,
        "--box", -1, -1, -0.5, 1, 1, 1, "--keep-components", 1, "--fill-holes", "all", "--max-triangles", 500,
        "--texture-size", 128, "--threads", 1,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    mesh = trimesh.load(tmp_path / "new" / "a.obj", force="mesh", process=False)
    assert 100 < len(mesh.faces) <= 500
    assert "Cut the mesh open for the texture in " in result.output
    assert mesh.visual.material.image.size == (128, 128)
    assert (np.abs(mesh.vertices) < 1.1).all()
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["a.mtl", "a.obj", "a.png"]


@pytest.mark.exhaustive
def test_surface_levels_of_detail_match_single_runs(run, octasplat, tmp_path):
    options = (*SMALL, "--texture-size", 64, "--threads", 1)
    result = octasplat(
        "surface", run.output, "-o", tmp_path / "a.glb", *options, "--max-triangles", "0.3k,100"
    )
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a_0.3k.glb", "a_100.glb"]
    counts = [len(trimesh.load(tmp_path / name, force="mesh").faces) for name in ("a_0.3k.glb", "a_100.glb")]
    assert 100 < counts[0] <= 300 and 50 < counts[1] <= 100
    assert result.output.count("Rendered") == 1 and result.output.count("Wrote") == 2
    octasplat("surface", run.output, "-o", tmp_path / "b.glb", *options, "--max-triangles", 100)
    assert (tmp_path / "b.glb").read_bytes() == (tmp_path / "a_100.glb").read_bytes()


def usdz_rotation(path):
    """The rotation of the root of a USDZ, columns."""
    usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed")
    from pxr import UsdGeom

    stage = usd.Stage.Open(str(path))
    root = UsdGeom.XformCache().GetLocalToWorldTransform(stage.GetDefaultPrim())
    return np.array(root)[:3, :3].T


def glb_rotation(path):
    """The rotation of the root node of a GLB, as its document says it."""
    return rotation_of(GlbFile(path).document["nodes"][0]["rotation"])


def test_surface_stands_upright_as_export_does(run, octasplat, tmp_path):
    # z is up in this world
    rotations = np.stack(
        [view.rotation_cam_from_world for view in read_views(run.output / "views.json").views]
    )
    up = estimate_up(rotations)
    assert up[2] > 0.9
    for name in ("a.glb", "a.usdz"):
        result = octasplat("surface", run.output, "-o", tmp_path / name, *SMALL)
        assert result.exit_code == 0, result.output
    result = octasplat("export", run.output, tmp_path / "surface.usdz", tmp_path / "surface.glb")
    assert result.exit_code == 0, result.output
    turns = [glb_rotation(tmp_path / name) for name in ("surface.glb", "a.glb")]
    turns += [usdz_rotation(tmp_path / name) for name in ("surface.usdz", "a.usdz")]
    for turn in turns:
        np.testing.assert_allclose(turn, turns[0], atol=1e-6)
        np.testing.assert_allclose(turn @ up, [0, 1, 0], atol=0.02)


def test_surface_of_file_stands_as_cameras_of_dataset_tell(run, octasplat, tmp_path):
    for name, given in (("a.glb", ()), ("b.glb", ("--dataset", run.scene))):
        result = octasplat("surface", run.output / "scene.ply", *given, "-o", tmp_path / name, *SMALL)
        assert result.exit_code == 0, result.output
    # without cameras by half about x, as COLMAP's y points down
    np.testing.assert_allclose(glb_rotation(tmp_path / "a.glb"), np.diag([1, -1, -1]), atol=1e-9)
    np.testing.assert_allclose(glb_rotation(tmp_path / "b.glb") @ [0, 0, 1], [0, 1, 0], atol=0.05)


def test_surface_unbounded_quiet_prints_nothing(run, octasplat, tmp_path):
    result = octasplat("surface", run.output, "-o", tmp_path / "a.ply", *SMALL, "--unbounded", "--quiet")
    assert result.exit_code == 0, result.output
    assert result.output == ""
    assert (tmp_path / "a.ply").exists()


def test_surface_of_file_uses_surrounding_cameras(run, octasplat, tmp_path):
    result = octasplat(
        "surface", run.output / "scene.ply", "-o", tmp_path / "a.ply", "--resolution", 32, "--depth-side", 24
    )
    assert result.exit_code == 0, result.output
    lines = result.output.splitlines()
    started = ["Rendering depth", "Fusing depth", "Meshing", "Coloring"]
    assert [line for line in lines if line in started] == started
    finished = [line.partition(" in ")[0] for line in lines if line.endswith(" s")]
    assert finished[:3] == ["Rendered 96 depth maps", "Fused the depth maps", "Made the mesh"]
    assert re.fullmatch(r"Colored [\d,]+ points", finished[3])


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (("-o", "a.stl"), "written as .glb, .ply, .obj or .usdz"),
        (("-o", "a.ply", "--texture-size", 128), "holds no texture"),
        (("-o", "a.glb", "--unbounded", "--box", 0, 0, 0, 1, 1, 1), "contradict"),
        (("-o", "a.glb", "--voxel", "0.1", "--resolution", "64"), "give one of them"),
        (("-o", "a.glb", "--box", 0, 0, 0, 1, 1, 0), "x0 < x1"),
        (("-o", "a.glb", "--box", 90, 90, 90, 91, 91, 91), "--box"),
        (("-o", "a.glb", "--max-memory", "0.0001"), "allowed"),
        (("-o", "a.glb", "--dataset", "nowhere"), "nowhere"),
    ],
)
def test_refusals_are_one_sentence(run, octasplat, tmp_path, monkeypatch, options, complaint):
    monkeypatch.chdir(tmp_path)
    result = octasplat("surface", run.output, *SMALL, *options, "--quiet")
    assert result.exit_code == 1
    assert complaint in result.output
    assert result.output.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "bad",
    [
        ("--fill-holes", "some"),
        ("--fill-holes", "-1"),
        ("--max-triangles", "5q"),
        ("--max-triangles", "3"),
        ("--max-triangles", "5k,5000"),
    ],
)
def test_surface_invalid_options_are_refused(run, octasplat, tmp_path, bad):
    result = octasplat("surface", run.output, "-o", tmp_path / "a.glb", *bad)
    assert result.exit_code == 1 and result.stderr.startswith(f"Error: {bad[0]}: ")
    assert bad[1].split(",")[-1] in result.output


@pytest.mark.exhaustive
def test_surface_interrupted_leaves_no_files(run, start_octasplat, tmp_path):
    process = start_octasplat(
        "surface", run.output, "-o", tmp_path / "a.ply", "--depth-side", 64, "--resolution", 2000,
        "--threads", 1,
    )  # fmt: skip
    assert process.stdout is not None
    assert "Rendering" in process.stdout.readline()
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    _, complaint = process.communicate(timeout=120)
    assert process.returncode == 130
    assert "Stopped" in complaint
    assert list(tmp_path.iterdir()) == []
