"""A lit surface in other programs: valid, with the tangents that Blender has, and as bright as ours."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octasplat.engine.files import write_surface
from octasplat.engine.gaussians.frames import frames_from_normals, quaternions_from_matrices
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from octasplat.engine.pathtracing.environment import EnvironmentMap
from octasplat.engine.pathtracing.relighting.path_relighter import PathRelighter
from octasplat.engine.pathtracing.stage.model import Integrator
from octasplat.engine.render.environment_files import write_environment
from octasplat.engine.render.pinhole_camera import PinholeCamera, focal_from_fov
from octasplat.engine.render.pose_paths import look_at
from octasplat.engine.shading.environment_frame import environment_frame
from octasplat.engine.surface.bake_materials import material_features
from octasplat.engine.surface.depth_cameras import cameras_around
from octasplat.engine.surface.extract import extract_levels
from octasplat.engine.surface.options import ExtractionOptions
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import TraceSettings
from tests.support.blender_python import SCRIPTS, run_blender
from tests.support.lit_surface import render_in_cycles, render_in_threejs, view_of

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

FRAME = environment_frame(np.array([0.0, 0.0, 1.0]))


def egg() -> FlatGaussians:
    """A ball drawn out along z, brass above and red plastic below."""
    count = 4000
    order = np.arange(count)
    height, angle = 1 - (2 * order + 1) / count, order * 2.399963229728653
    across = np.sqrt(1 - height**2)
    ball = np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1)
    normals = ball / [1, 1, 1.4]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    above = height[:, None] > 0.1
    scene = FlatGaussians(
        (ball * [1, 1, 1.4]).astype(np.float32),
        quaternions_from_matrices(frames_from_normals(normals)).astype(np.float32),
        np.full((count, 2), np.log(0.05), np.float32),
        np.full(count, 6.0, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )
    return scene.with_channels(
        {
            "albedo": np.where(above, [0.8, 0.6, 0.3], [0.7, 0.05, 0.05]).astype(np.float32),
            "metallic": above.astype(np.float32),
            "roughness": np.where(above, 0.25, 0.5).astype(np.float32),
        }
    )


@pytest.fixture(scope="module")
def surface(tmp_path_factory: pytest.TempPathFactory) -> TriangleMesh:
    scene = egg()
    tracer = CpuTracer(threads=2)
    tracer.build(scene, material_features(scene))
    options = ExtractionOptions(resolution=64, depth_side=128, texture_size=256)
    (extracted,) = extract_levels(
        tracer, cameras_around(scene, 128, 40), options, (3000,),
        scratch=tmp_path_factory.mktemp("scratch"), light_frame=FRAME,
    )  # fmt: skip
    return extracted.mesh


@pytest.fixture(scope="module")
def glb(surface: TriangleMesh, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_surface(surface, tmp_path_factory.mktemp("lit") / "egg.glb")[0]


@pytest.fixture(scope="module")
def light() -> np.ndarray:
    """A sky with a warm side that is brighter, and darker ground, so that every turn of it shows."""
    v, u = np.meshgrid((np.arange(32) + 0.5) / 32, (np.arange(64) + 0.5) / 64, indexing="ij")
    warm = np.exp(-((u - 0.65) ** 2 + (v - 0.4) ** 2) / 0.01)[..., None] * [3.0, 1.5, 0.5]
    return (warm + np.where(v < 0.5, 0.8, 0.2)[..., None] * [0.6, 0.8, 1.0]).astype(np.float32)


def test_lit_surface_glb_passes_khronos_validator(
    validate_glb: Callable[[Path], dict[str, Any]], glb: Path
) -> None:
    issues = validate_glb(glb)["issues"]
    counts = [issues[name] for name in ("numErrors", "numWarnings", "numInfos", "numHints")]
    assert counts == [0, 0, 0, 0], issues


def test_blender_has_the_same_triangles_and_tangents(
    surface: TriangleMesh, glb: Path, tmp_path: Path
) -> None:
    run_blender(SCRIPTS / "read_tangents.py", glb, tmp_path / "found.npz")
    found = np.load(tmp_path / "found.npz")
    assert surface.materials is not None and surface.uv is not None
    assert found["triangles"] == len(surface.faces)
    corners = surface.faces.reshape(-1)
    # Blender turns y up to z up; its v grows upwards.
    turn = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) @ FRAME[[2, 1, 0]]
    np.testing.assert_allclose(found["uv"], surface.uv[corners] * [1, -1] + [0, 1], atol=1e-5)
    tangents = surface.materials.tangents[corners]
    cosines = (found["tangents"] * (tangents[:, :3] @ turn.T)).sum(axis=1)
    assert (cosines > 0.999).mean() > 0.99
    assert (found["signs"] == tangents[:, 3]).mean() > 0.99


@pytest.mark.exhaustive
def test_lit_surface_matches_cycles_and_threejs(glb: Path, light: np.ndarray, tmp_path: Path) -> None:
    write_environment(tmp_path / "light.hdr", light)
    place = np.array([3.0, 3.0, 1.5])
    camera = PinholeCamera.from_pose(
        look_at(place, np.zeros(3), np.array([0.0, 0.0, 1.0])), 96, 96, fy_px=focal_from_fov(45, 96)
    )
    ours = PathRelighter(egg(), TraceSettings(), Integrator(samples=64, max_depth=4), threads=2)
    ours.set_environment(EnvironmentMap(light, FRAME))
    picture = ours.render(camera.rays())
    inside = picture.coverage > 0.99
    wanted = np.clip(picture.composite_over(np.zeros(3, np.float32)), 0, 1)
    view = view_of(camera, FRAME)
    for label, seen, least in (
        ("Cycles", render_in_cycles(glb, tmp_path / "light.hdr", view, 32), 33.0),
        ("three.js", render_in_threejs(glb, tmp_path / "light.hdr", view), 30.0),
    ):
        decibels = -10 * np.log10(np.mean((np.clip(seen, 0, 1) - wanted)[inside] ** 2))
        assert decibels > least, (label, decibels)
