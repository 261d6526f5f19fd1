"""Blender opens our meshes: what it keeps of them, and how Cycles draws them."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.ply_container import read_ply
from octasplat.engine.files import ExportOptions, export_scene
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import octagon_corners_world, octagon_radii
from octasplat.engine.render.image_files import read_image, write_exr
from octasplat.engine.render.path_file import read_camera_path
from tests.support.blender_python import EXPORT_PATH_SCRIPT, IMPORT_SCRIPT, SCRIPTS, run_blender
from tests.support.shell_scene import our_view, psnr_db, shell_cameras, shell_scene, write_shell_cameras

pytestmark = [pytest.mark.tools, pytest.mark.heavy]

COUNT = 1000


@pytest.fixture(scope="module")
def scene() -> FlatGaussians:
    return shell_scene(COUNT)


@pytest.fixture(scope="module")
def blend(scene: FlatGaussians, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene as the script that we ship opens it, saved; its mesh lies beside it."""
    folder = tmp_path_factory.mktemp("blend")
    export_scene(scene, folder / "scene.mesh.ply")
    write_shell_cameras(folder / "cameras.json")
    blend = folder / "scene.blend"
    run_blender(IMPORT_SCRIPT, folder / "scene.mesh.ply", blend, "--cameras", folder / "cameras.json")
    return blend


def assert_same_ply(edited: Path, original: Path) -> None:
    expected = read_ply(original, ["vertex", "face"])[1]
    tables = read_ply(edited, ["vertex", "face"])[1]
    for name in expected["vertex"].dtype.names or ():
        assert tables["vertex"][name].tobytes() == expected["vertex"][name].tobytes(), name
    np.testing.assert_array_equal(tables["face"]["vertex_indices"], expected["face"]["vertex_indices"])


@pytest.mark.parametrize("frame", [0, 1])
def test_cycles_render_equals_tracer(scene: FlatGaussians, blend: Path, tmp_path: Path, frame: int) -> None:
    image = tmp_path / "cycles.png"
    run_blender(SCRIPTS / "render_blend.py", blend, image, frame + 1)
    assert psnr_db(image, our_view(scene, shell_cameras()[frame])) >= 55.0


@pytest.mark.exhaustive
@pytest.mark.parametrize(("name", "view"), [("a.glb", "standard"), ("a.mesh.ply", "standard")])
def test_blender_standard_view_matches(scene: FlatGaussians, tmp_path: Path, name: str, view: str) -> None:
    """Of a GLB, too, whose colors and opacities Blender keeps in 8 bits."""
    export_scene(scene, tmp_path / name, ExportOptions(chunks=2))
    write_shell_cameras(tmp_path / "cameras.json")
    given = (tmp_path / name, tmp_path / "a.blend", "--cameras", tmp_path / "cameras.json", "--view", view)
    run_blender(IMPORT_SCRIPT, *given)
    run_blender(SCRIPTS / "render_blend.py", tmp_path / "a.blend", tmp_path / "cycles.png", 1)
    assert psnr_db(tmp_path / "cycles.png", our_view(scene, shell_cameras()[0])) >= 45.0


def test_blender_camera_exports_as_path(blend: Path, tmp_path: Path) -> None:
    run_blender(EXPORT_PATH_SCRIPT, tmp_path / "path.json", "--blend", blend)
    given, back = (
        read_camera_path(path) for path in (blend.with_name("cameras.json"), tmp_path / "path.json")
    )
    assert len(back.cameras) == len(given.cameras) > 1
    for one, other in zip(given.cameras, back.cameras, strict=True):
        np.testing.assert_allclose(other.world_from_cam, one.world_from_cam, atol=1e-5)
        for name in ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px"):
            assert getattr(other, name) == pytest.approx(getattr(one, name), rel=1e-5), name


@pytest.mark.exhaustive
def test_blender_script_renders_alone(scene: FlatGaussians, tmp_path: Path) -> None:
    export_scene(scene, tmp_path / "mesh.ply")
    image = tmp_path / "view.png"
    run_blender(IMPORT_SCRIPT, tmp_path / "mesh.ply", tmp_path / "a.blend", "--samples", 1, "--render", image)
    pixels = read_image(image)
    lit = np.argwhere(pixels.max(axis=-1) > 0.1)
    assert len(lit) > 0.02 * pixels.shape[0] * pixels.shape[1]
    middle = lit.mean(axis=0) / pixels.shape[:2]
    np.testing.assert_allclose(middle, 0.5, atol=0.1)


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("scene.ply", None, "first run: octasplat export"),
        ("none.ply", b"", "no such file"),
        ("text.ply", b"hello\n", "is not a PLY file"),
    ],
)
def test_blender_script_names_unreadable_file(
    scene: FlatGaussians, tmp_path: Path, name: str, content: bytes | None, message: str
) -> None:
    if content is None:
        export_scene(scene, tmp_path / name)
    elif content:
        (tmp_path / name).write_bytes(content)
    output = run_blender(IMPORT_SCRIPT, tmp_path / name, tmp_path / "a.blend", fails=True)
    assert message in output and "Traceback" not in output
    assert not (tmp_path / "a.blend").exists()


def test_blender_mesh_ply_round_trip(scene: FlatGaussians, tmp_path: Path) -> None:
    export_scene(scene, tmp_path / "a.mesh.ply")
    run_blender(SCRIPTS / "round_trip.py", tmp_path / "a.mesh.ply", tmp_path / "b.ply")
    assert_same_ply(tmp_path / "b.ply", tmp_path / "a.mesh.ply")


def test_blender_script_mesh_ply_round_trip(blend: Path, tmp_path: Path) -> None:
    run_blender(SCRIPTS / "round_trip.py", blend, tmp_path / "b.ply")
    assert_same_ply(tmp_path / "b.ply", blend.with_name("scene.mesh.ply"))


@pytest.mark.exhaustive
def test_blender_obj_keeps_order_colors_and_texture_coordinates(scene: FlatGaussians, tmp_path: Path) -> None:
    export_scene(scene, tmp_path / "a.obj")
    run_blender(SCRIPTS / "round_trip.py", tmp_path / "a.obj", tmp_path / "b.obj")
    before, after = (
        [line.split() for line in (tmp_path / name).read_text().splitlines()] for name in ("a.obj", "b.obj")
    )

    def numbers(lines: list[list[str]], keyword: str) -> np.ndarray:
        return np.array([words[1:] for words in lines if words and words[0] == keyword], dtype=float)

    np.testing.assert_allclose(numbers(after, "v")[:, :3], numbers(before, "v")[:, :3], atol=6e-7)
    np.testing.assert_allclose(numbers(after, "v")[:, 3:], numbers(before, "v")[:, 3:], atol=3e-4)

    def corners(lines: list[list[str]]) -> tuple[np.ndarray, np.ndarray]:
        faces = [words[1:] for words in lines if words and words[0] == "f"]
        pairs = np.array([[corner.split("/")[:2] for corner in face] for face in faces], dtype=int) - 1
        return pairs[..., 0], numbers(lines, "vt")[pairs[..., 1]]

    (vertices, uv), (expected_vertices, expected_uv) = corners(after), corners(before)
    np.testing.assert_array_equal(vertices, expected_vertices)
    np.testing.assert_allclose(uv, expected_uv, atol=2e-6)


def test_blender_glb_keeps_ids_and_exact_positions(scene: FlatGaussians, tmp_path: Path) -> None:
    albedo = np.random.default_rng(0).random((COUNT, 3), np.float32)
    scene = scene.with_channels({"albedo": albedo, "metallic": albedo[:, :1]})  # of several widths
    export_scene(scene, tmp_path / "a.glb", ExportOptions(chunks=2))
    run_blender(SCRIPTS / "round_trip.py", tmp_path / "a.glb", tmp_path / "b.glb")
    corners_world = octagon_corners_world(scene, octagon_radii(scene.opacities))
    seen = np.zeros((COUNT, 8), int)
    for attributes in attributes_of(tmp_path / "b.glb"):
        gid, corner = attributes["_GID"].astype(int), attributes["_CORNER"].astype(int)
        seen[gid, corner] += 1
        np.testing.assert_array_equal(attributes["POSITION"], corners_world[gid, corner])
        np.testing.assert_array_equal(attributes["_METALLIC"], albedo[gid, 0])
        np.testing.assert_array_equal(attributes["_ALBEDO_2"], albedo[gid, 2])
    np.testing.assert_array_equal(
        seen, np.broadcast_to(octagon_radii(scene.opacities)[:, None] > 0, seen.shape)
    )


def attributes_of(path: Path) -> list[dict[str, np.ndarray]]:
    """The float attributes of every primitive of a GLB."""
    data = path.read_bytes()
    (length,) = struct.unpack_from("<I", data, 12)
    document, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    result = []
    for mesh in document["meshes"]:
        (primitive,) = mesh["primitives"]
        arrays = {}
        for name, index in primitive["attributes"].items():
            accessor = document["accessors"][index]
            if accessor["componentType"] != 5126:
                continue
            view = document["bufferViews"][accessor["bufferView"]]
            width = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}[accessor["type"]]
            values = np.frombuffer(binary, "<f4", accessor["count"] * width, view["byteOffset"])
            arrays[name] = values.reshape(-1, width) if width > 1 else values
        result.append(arrays)
    return result


def test_blender_shows_the_layers_of_a_stage_as_sockets(tmp_path: Path) -> None:
    parts = [f"{part}{c}" for part in ("", "background.", "shadow.", "things.") for c in "RGBA"]
    write_exr(tmp_path / "a.exr", {name: np.full((4, 6), 0.5, np.float32) for name in parts})
    told = run_blender(SCRIPTS / "show_layers.py", tmp_path / "a.exr")
    assert "SOCKETS ['Alpha', 'Combined', 'background', 'shadow', 'things']" in told
