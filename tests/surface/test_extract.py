"""The whole way from Gaussians to colored files, on a tiled ball."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from octasplat.engine.core.errors import CancelledError, ConfigError, SceneFileError
from octasplat.engine.core.events import PhaseFinished
from octasplat.engine.files import write_surface
from octasplat.engine.geometry.triangle_mesh import TriangleMesh, edge_report
from octasplat.engine.render.image_files import read_image
from octasplat.engine.surface.depth_cameras import cameras_around
from octasplat.engine.surface.extract import ExtractedSurface, extract_levels
from octasplat.engine.surface.options import ExtractionOptions
from octasplat.engine.trace.cpu.tracer import CpuTracer
from tests.support.surface_shapes import cameras_on_sphere

RED, BLUE = (0.9, 0.1, 0.1), (0.1, 0.1, 0.9)


@pytest.fixture(scope="module")
def tracer(ball) -> CpuTracer:
    made = CpuTracer(threads=1)
    made.build(ball)
    return made


def extracted(tracer, tmp_path: Path, triangles: int | None = None, **settings) -> ExtractedSurface:
    options = ExtractionOptions(**{"resolution": 64, "depth_side": 96, **settings})
    cameras = cameras_on_sphere(30, 3.0, 96)
    (surface,) = extract_levels(tracer, cameras, options, (triangles,), scratch=tmp_path)
    return surface


@pytest.fixture(scope="module")
def surface(tracer, tmp_path_factory) -> ExtractedSurface:
    return extracted(tracer, tmp_path_factory.mktemp("scratch"))


@pytest.fixture(scope="module")
def textured(tracer, tmp_path_factory) -> TriangleMesh:
    return extracted(tracer, tmp_path_factory.mktemp("scratch"), triangles=2000, texture_size=256).mesh


def test_ball_comes_out_closed_round_and_in_its_colors(surface):
    mesh = surface.mesh
    assert surface.edges.is_watertight
    assert edge_report(mesh.faces) == surface.edges
    radii = np.linalg.norm(mesh.vertices_world, axis=1)
    # The tiles are flat and overlap, so that the median hit lies a little under the ball.
    assert np.abs(radii - 1).max() < 0.03
    height = mesh.vertices_world[:, 2]
    for side, color in ((height > 0.25, RED), (height < -0.25, BLUE)):
        np.testing.assert_allclose(mesh.rgb_srgb[side], np.broadcast_to(color, (side.sum(), 3)), atol=0.03)
    assert surface.volume_bytes == pytest.approx(surface.volume_bytes // (512 * 13) * 512 * 13)
    assert surface.triangles_found == len(mesh.faces)


def test_expected_depth_is_there_to_choose(tracer, surface, tmp_path):
    other = extracted(tracer, tmp_path, depth_mode="expected").mesh
    assert edge_report(other.faces).is_watertight
    assert len(other.vertices_world) != len(surface.mesh.vertices_world) or not np.array_equal(
        other.vertices_world, surface.mesh.vertices_world
    )


@pytest.mark.exhaustive
def test_texture_has_the_colors_where_its_coordinates_say(textured):
    mesh = textured
    assert mesh.texture_srgb.shape == (256, 256, 3)
    assert len(mesh.faces) <= 2000
    assert mesh.uv.min() >= 0 and mesh.uv.max() <= 1
    middle = mesh.face_corners_world.mean(axis=1)
    at = mesh.uv[mesh.faces].mean(axis=1) * 256
    shown = mesh.texture_srgb[at[:, 1].astype(int), at[:, 0].astype(int)] / 255
    for side, color in ((middle[:, 2] > 0.25, RED), (middle[:, 2] < -0.25, BLUE)):
        close = np.abs(shown[side] - color).max(axis=1) < 0.05
        assert close.mean() > 0.99


def test_surface_glb_round_trips(surface, textured, tmp_path):
    assert write_surface(surface.mesh, tmp_path / "a.glb") == (tmp_path / "a.glb",)
    seen = trimesh.load(tmp_path / "a.glb", force="mesh", process=False)
    turned = surface.mesh.vertices_world * [1, -1, -1]
    np.testing.assert_allclose(seen.vertices, turned, atol=1e-6)
    np.testing.assert_array_equal(seen.faces, surface.mesh.faces)
    write_surface(textured, tmp_path / "b.glb")
    seen = trimesh.load(tmp_path / "b.glb", force="mesh", process=False)
    image = np.asarray(seen.visual.material.baseColorTexture.convert("RGB"))
    np.testing.assert_array_equal(image, textured.texture_srgb)
    np.testing.assert_allclose(seen.visual.uv, textured.uv * [1, -1] + [0, 1], atol=1e-6)


def test_glb_states_its_lengths(surface, tmp_path):
    data = write_surface(surface.mesh, tmp_path / "a.glb")[0].read_bytes()
    magic, version, total = struct.unpack("<4sII", data[:12])
    assert (magic, version, total) == (b"glTF", 2, len(data))
    length = struct.unpack("<I", data[12:16])[0]
    document = json.loads(data[20 : 20 + length])
    assert document["buffers"][0]["byteLength"] == len(data) - 28 - length
    assert document["materials"][0]["extensions"] == {"KHR_materials_unlit": {}}
    assert {view["byteOffset"] % 4 for view in document["bufferViews"]} == {0}


def test_surface_ply_and_obj_round_trip(surface, textured, tmp_path):
    for name in ("a.ply", "a.obj"):
        assert write_surface(surface.mesh, tmp_path / name) == (tmp_path / name,)
        seen = trimesh.load(tmp_path / name, process=False)
        np.testing.assert_allclose(seen.vertices, surface.mesh.vertices_world, atol=1e-6)
        np.testing.assert_array_equal(seen.faces, surface.mesh.faces)
        np.testing.assert_allclose(seen.visual.vertex_colors[:, :3] / 255, surface.mesh.rgb_srgb, atol=0.003)
    files = write_surface(textured, tmp_path / "b.obj")
    assert [path.name for path in files] == ["b.obj", "b.mtl", "b.png"]
    np.testing.assert_allclose(read_image(files[2]) * 255, textured.texture_srgb, atol=0.01)
    seen = trimesh.load(files[0], process=False)
    assert len(seen.faces) == len(textured.faces)
    image = np.asarray(seen.visual.material.image.convert("RGB"))
    # The same triangle shows the same pixel as in the mesh itself.
    np.testing.assert_array_equal(image, textured.texture_srgb)
    ours = textured.uv[textured.faces] * [1, -1] + [0, 1]
    np.testing.assert_allclose(seen.visual.uv[seen.faces], ours, atol=1e-5)


def test_extract_unwritable_file_is_refused(surface, textured, tmp_path):
    with pytest.raises(ConfigError, match=r"\.glb, \.ply, \.obj or \.usdz"):
        write_surface(surface.mesh, tmp_path / "a.stl")
    with pytest.raises(ConfigError, match="no texture"):
        write_surface(textured, tmp_path / "a.ply")
    (tmp_path / "file").write_text("")
    with pytest.raises(SceneFileError, match="cannot be written"):
        write_surface(surface.mesh, tmp_path / "file" / "a.glb")


def test_surface_extraction_reports_stages_and_stops_cleanly(tracer, tmp_path):
    options = ExtractionOptions(resolution=32, depth_side=32)
    cameras = cameras_on_sphere(12, 3.0, 32)
    heard = []
    extract_levels(tracer, cameras, options, scratch=tmp_path, listener=heard.append)
    finished = [event.stage for event in heard if isinstance(event, PhaseFinished)]
    assert finished == ["depth", "fusing", "meshing", "coloring", "fitting"]
    for stop_at in range(1, 40, 9):
        asked = iter(range(1000))
        with pytest.raises(CancelledError):
            extract_levels(
                tracer,
                cameras,
                options,
                scratch=tmp_path,
                should_stop=lambda: next(asked) >= stop_at,  # noqa: B023
            )
    assert list(tmp_path.iterdir()) == []


def test_surface_default_cameras_cover_ball(ball, tracer, tmp_path):
    cameras = cameras_around(ball, 64, count=40)
    options = ExtractionOptions(resolution=48, depth_side=64)
    (extracted,) = extract_levels(tracer, cameras, options, scratch=tmp_path)
    mesh = extracted.mesh
    assert edge_report(mesh.faces).is_watertight
    assert np.abs(np.linalg.norm(mesh.vertices_world, axis=1) - 1).max() < 0.04


def test_surface_contradictory_options_are_refused():
    with pytest.raises(ValueError, match="contradict"):
        ExtractionOptions(unbounded=True, box=(0, 0, 0, 1, 1, 1))
    with pytest.raises(ValueError, match="x0 < x1"):
        ExtractionOptions(box=(0, 0, 0, 1, -1, 1))
