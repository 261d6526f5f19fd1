"""``octasplat surface --materials``: the file, the light beside it, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.files.glb_container import GlbFile
from octasplat.engine.gaussians.frames import frames_from_normals, quaternions_from_matrices
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.environment_files import write_environment

SMALL = ("--resolution", 32, "--depth-side", 24, "--texture-size", 64, "--max-triangles", 400, "--threads", 1)


@pytest.fixture(scope="module")
def shiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a run leaves it, as far as it matters: a shiny ball and its light; a plain ball."""
    folder = tmp_path_factory.mktemp("shiny")
    normals = np.random.default_rng(0).standard_normal((800, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    ball = FlatGaussians(
        normals.astype(np.float32),
        quaternions_from_matrices(frames_from_normals(normals)).astype(np.float32),
        np.full((800, 2), np.log(0.12), np.float32),
        np.full(800, 6.0, np.float32),
        np.zeros((800, 1, 3), np.float32),
    )
    channels = {"albedo": 3, "metallic": 1, "roughness": 1}
    lit = ball.with_channels({name: np.full((800, k), 0.5, np.float32) for name, k in channels.items()})
    write_gaussian_ply(lit, folder / "scene.ply")
    write_gaussian_ply(ball, folder / "plain.ply")
    write_environment(folder / "environment.hdr", np.full((8, 16, 3), 0.7, np.float32))
    return folder


def test_surface_of_run_has_textures_and_environment(shiny, octasplat, tmp_path):
    result = octasplat("surface", shiny, "--materials", "-o", tmp_path / "a.glb", *SMALL)
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.glb", "environment.hdr"]
    assert (tmp_path / "environment.hdr").read_bytes() == (shiny / "environment.hdr").read_bytes()
    document = GlbFile(tmp_path / "a.glb").document
    assert [image["name"] for image in document["images"]] == ["surface", "materials", "normals"]
    # Again, over what is there; another environment there is not written over.
    assert octasplat("surface", shiny, "--materials", "-o", tmp_path / "a.glb", *SMALL).exit_code == 0
    write_environment(tmp_path / "environment.hdr", np.full((8, 16, 3), 0.2, np.float32))
    result = octasplat("surface", shiny, "--materials", "-o", tmp_path / "b.glb", *SMALL, "--quiet")
    assert result.exit_code == 1 and result.output.count("\n") == 1
    assert "another environment" in result.output
    assert not (tmp_path / "b.glb").exists()


@pytest.mark.exhaustive
def test_surface_lit_up_axis_option_orients_glb(shiny, octasplat, tmp_path):
    for up, axis in (((), (0, -1, 0)), (("--up", "z"), (0, 0, 1))):
        result = octasplat(
            "surface", shiny / "scene.ply", "--materials", *up, "-o", tmp_path / "a.glb", *SMALL
        )
        assert result.exit_code == 0, result.output
        ((matrix, _),) = GlbFile(tmp_path / "a.glb").primitives()
        np.testing.assert_allclose(matrix[:3, :3] @ axis, (0, 1, 0), atol=1e-9)
    assert [path.name for path in tmp_path.iterdir()] == ["a.glb"]


@pytest.mark.parametrize(
    ("source", "name", "complaint"),
    [("plain.ply", "a.glb", "has no materials"), ("scene.ply", "a.obj", "written as .glb")],
)
def test_surface_lit_unusable_input_is_refused(shiny, octasplat, tmp_path, source, name, complaint):
    result = octasplat("surface", shiny / source, "--materials", "-o", tmp_path / name, *SMALL, "--quiet")
    assert result.exit_code == 1
    assert complaint in result.output and result.output.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_lit_octagon_export(shiny, octasplat, tmp_path):
    result = octasplat("export", shiny, tmp_path / "a.glb", "--materials", "--up", "z", "--chunks", 1)
    assert result.exit_code == 0, result.output
    document = GlbFile(tmp_path / "a.glb").document
    assert [image["name"] for image in document["images"]] == ["radial_alpha", "materials"]
    result = octasplat("export", shiny / "plain.ply", tmp_path / "b.glb", "--materials")
    assert result.exit_code == 1 and "plain.ply has no materials" in result.output
    result = octasplat("export", shiny, tmp_path / "b.ply", "--materials")
    assert result.exit_code == 2 and "--materials is for GLB of octagons" in result.output
    result = octasplat("export", shiny, tmp_path / "b.glb", "--up", "z")
    assert result.exit_code == 2 and "--up goes with --materials" in result.output
    result = octasplat("surface", shiny, "-o", tmp_path / "b.glb", "--up", "z")
    assert result.exit_code == 1 and "--up: goes with materials" in result.output
    assert [path.name for path in tmp_path.iterdir()] == ["a.glb"]
