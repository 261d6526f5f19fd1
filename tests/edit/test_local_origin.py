"""Scenes about a local origin: moved, put together, cropped, exported and read back in user coordinates."""

import json
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.local_origin import NO_ORIGIN, origin_after, vertices_about
from octasplat.engine.files import ExportOptions, export_scene, read_mesh, read_metadata, read_scene
from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.scene_metadata import SceneMetadata

ORIGIN = (512_345.0, 5_403_210.0, 310.0)


@pytest.fixture
def far(make_scene, tmp_path: Path) -> Path:
    write_gaussian_ply(make_scene(150), tmp_path / "far.ply", facts=SceneMetadata(origin_world=ORIGIN))
    return tmp_path / "far.ply"


def user_positions(path: Path) -> np.ndarray:
    return read_scene(path)[0].means_world.astype(np.float64) + np.array(read_metadata(path).origin_world)


def test_ply_keeps_the_origin_as_a_comment(far, make_scene, tmp_path) -> None:
    assert read_metadata(far).origin_world == ORIGIN
    write_gaussian_ply(make_scene(150), tmp_path / "near.ply")
    assert b"origin" not in (tmp_path / "near.ply").read_bytes()


@pytest.mark.parametrize(
    "name", ["out.ply", "mesh.ply", "out.compressed.ply", "out.splats.glb", "mesh.glb", "lit.usda"]
)
def test_exports_hold_the_origin_and_come_back(octasplat, far, tmp_path, name) -> None:
    result = octasplat("export", far, tmp_path / name)
    assert result.exit_code == 0, result.output
    assert "no place for the origin" not in result.output
    if name == "lit.usda":
        assert "xformOp:translate = (512345, -5403210, -310)" in (tmp_path / name).read_text()
        return
    assert read_metadata(tmp_path / name).origin_world == ORIGIN
    # Compressed PLY has 11 bits for the extent of a chunk.
    tolerance = 2e-3 if "compressed" in name else 1e-6
    np.testing.assert_allclose(
        np.sort(user_positions(tmp_path / name), axis=0), np.sort(user_positions(far), axis=0), atol=tolerance
    )


@pytest.mark.parametrize("name", ["out.splat", "out.spz"])
def test_formats_without_a_place_for_the_origin_are_named(octasplat, far, tmp_path, name) -> None:
    result = octasplat("export", far, tmp_path / name)
    assert result.exit_code == 0, result.output
    assert "no place for the origin of large coordinates; add 512345 5403210 310" in " ".join(
        result.output.split()
    )


def test_losses_of_files_beside_a_lit_mesh_are_told(octasplat, make_scene, tmp_path) -> None:
    scene = make_scene(40)
    materials = {"albedo": np.full((40, 3), 0.5, np.float32)}
    materials |= {name: np.full((40, 1), 0.5, np.float32) for name in ("metallic", "roughness")}
    facts = SceneMetadata(origin_world=ORIGIN)
    write_gaussian_ply(scene.with_channels(materials), tmp_path / "far.ply", facts=facts)
    files = (tmp_path / "lit.glb", tmp_path / "small.spz")
    result = octasplat("export", tmp_path / "far.ply", *files, "--materials")
    assert result.exit_code == 0, result.output
    output = " ".join(result.output.split())
    assert "The format spz has no place for the origin of large coordinates" in output
    assert "format glb" not in output
    assert "no place" not in octasplat("export", tmp_path / "far.ply", files[0], "--materials").output


def test_glb_says_the_position_to_programs_that_know_nothing_of_us(far, tmp_path) -> None:
    gaussians, facts = read_scene(far)[0], read_metadata(far)
    export_scene(gaussians, tmp_path / "mesh.glb", ExportOptions(facts=facts))
    vertices = read_mesh(tmp_path / "mesh.glb").vertices  # with the transforms of nodes, y up
    np.testing.assert_allclose(vertices.mean(axis=0), [512_345.0, -5_403_210.0, -310.0], atol=1.0)
    local = vertices_about(vertices, ORIGIN)
    assert np.abs(local).max() < 5.0


@pytest.mark.parametrize(
    ("axes", "height"),
    [
        (np.eye(3), -45.0),
        (np.diag([1.0, -1, -1]), -45.0),
        (np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), -45.0),
        (np.diag([-1.0, 1, 1]), 5.0),
    ],
    ids=["as the scene", "half turn", "y up", "mirrored"],
)
def test_meshes_below_the_sea_are_put_about_an_origin_above_it(axes: np.ndarray, height: float) -> None:
    origin = (512_350.0, 5_403_210.0, 40.0)
    local = np.random.default_rng(0).uniform(-20, 20, (200, 3)) + np.array([0.0, 0.0, height])
    found = vertices_about((local + origin) @ axes.T, origin)
    np.testing.assert_allclose(found, local @ axes.T, atol=1e-6)


def test_edited_mesh_of_large_coordinates_finds_its_gaussians(octasplat, far, tmp_path) -> None:
    for name in ("mesh.glb", "mesh.ply", "mesh.obj"):
        assert octasplat("export", far, tmp_path / name).exit_code == 0
        result = octasplat("edit", far, "--mesh", tmp_path / name, "-o", tmp_path / f"{name}.out.ply")
        assert result.exit_code == 0, result.output
        assert "0 Gaussians moved, 150 did not" in result.output
        assert (tmp_path / f"{name}.out.ply").read_bytes() == far.read_bytes()


def test_transform_takes_user_coordinates(octasplat, far, tmp_path) -> None:
    out = tmp_path / "out.ply"
    before = user_positions(far)
    move = (
        "--rotate",
        "z",
        "90",
        "--scale",
        "2",
        "--about",
        *map(str, ORIGIN),
        "--translate",
        "10",
        "20",
        "30",
    )
    assert octasplat("transform", far, *move, "-o", out).exit_code == 0
    offsets = 2 * (before - ORIGIN) @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).T
    np.testing.assert_allclose(user_positions(out), offsets + ORIGIN + [10, 20, 30], atol=1e-5)
    assert read_metadata(out).origin_world == (512_355.0, 5_403_230.0, 340.0)


def test_transform_to_and_from_the_origin_keeps_every_digit(octasplat, far, tmp_path) -> None:
    near, back = tmp_path / "near.ply", tmp_path / "back.ply"
    away = [str(-value) for value in ORIGIN]
    assert octasplat("transform", far, "--translate", *away, "-o", near).exit_code == 0
    assert read_metadata(near).origin_world == NO_ORIGIN
    np.testing.assert_array_equal(read_scene(near)[0].means_world, read_scene(far)[0].means_world)
    assert octasplat("transform", near, "--translate", *map(str, ORIGIN), "-o", back).exit_code == 0
    np.testing.assert_allclose(user_positions(back), user_positions(far), atol=1e-6)


@pytest.mark.parametrize("count", [1, 3])
def test_gaussians_in_one_place_keep_their_digits(count: int) -> None:
    place = np.tile(np.float32([0.3, 0.1, 0.2]), (count, 1))
    moved, back = np.eye(4), np.eye(4)
    moved[:3, 3], back[:3, 3] = (0.25, 0.0, 0.0), np.negative(ORIGIN)
    assert origin_after(moved, place, ORIGIN) == (ORIGIN[0] + 0.25, *ORIGIN[1:])
    assert origin_after(back, place, ORIGIN) == origin_after(moved, place, NO_ORIGIN) == NO_ORIGIN
    # one that lies at its local origin and comes near that of the world needs none any more
    near = np.eye(4)
    near[:3, 3] = -np.array(ORIGIN) + 1.0
    assert origin_after(near, np.zeros((1, 3)), ORIGIN, size=2.0) == NO_ORIGIN
    assert origin_after(moved, np.zeros((1, 3)), ORIGIN, size=2.0) == (ORIGIN[0] + 0.25, *ORIGIN[1:])


def test_merge_brings_scenes_of_other_origins_together(octasplat, far, make_scene, tmp_path) -> None:
    other = tmp_path / "other.ply"
    origin = (512_350.0, 5_403_200.0, 310.0)
    write_gaussian_ply(make_scene(50, seed=3), other, facts=SceneMetadata(origin_world=origin))
    assert octasplat("merge", far, other, "-o", tmp_path / "out.ply").exit_code == 0
    np.testing.assert_allclose(
        user_positions(tmp_path / "out.ply"),
        np.concatenate([user_positions(far), user_positions(other)]),
        atol=1e-5,
    )


def test_crop_takes_user_coordinates(octasplat, far, tmp_path) -> None:
    positions = user_positions(far)
    x, y, z = ORIGIN
    kept = (positions > [x, y, z]).all(axis=1)
    box = map(str, (x, y, z, x + 9, y + 9, z + 9))
    sphere = map(str, (x, y, z, 0.8))
    for arguments, mask in (
        (("--box", *box), kept),
        (("--sphere", *sphere), np.linalg.norm(positions - ORIGIN, axis=1) < 0.8),
        (("--where", f"x > {x} and y > {y} and z > {z}"), kept),
    ):
        result = octasplat("crop", far, *arguments, "-o", tmp_path / "out.ply", "--overwrite")
        assert result.exit_code == 0, result.output
        np.testing.assert_array_equal(user_positions(tmp_path / "out.ply"), positions[mask])


def test_info_tells_user_coordinates(octasplat, far, tmp_path) -> None:
    result = octasplat("info", far, "-o", tmp_path / "info.json")
    assert result.exit_code == 0, result.output
    assert "origin      512345 5403210 310" in result.output
    assert "512344.0" in result.output  # the least x is about 1 below the origin
    assert json.loads((tmp_path / "info.json").read_text())["origin_world"] == list(ORIGIN)


def test_render_takes_cameras_in_user_coordinates(octasplat, far, make_scene, tmp_path) -> None:
    from octasplat.engine.render.image_files import read_image

    near = tmp_path / "near.ply"
    write_gaussian_ply(make_scene(150), near)
    x, y, z = ORIGIN
    size = ("--width", "24", "--height", "16", "--fov", "50")
    pictures = []
    for scene, centre in ((near, (0.0, 0.0, 0.0)), (far, (x, y, z))):
        eye = [str(value) for value in (centre[0] + 1, centre[1] - 2, centre[2] - 4)]
        target = [str(value) for value in centre]
        out = tmp_path / f"{scene.stem}.png"
        result = octasplat("render", scene, "-o", out, "--camera", *eye, "--look-at", *target, *size)
        assert result.exit_code == 0, result.output
        pictures.append(read_image(out))
    np.testing.assert_array_equal(pictures[0], pictures[1])
    assert np.ptp(pictures[0]) > 0


@pytest.mark.parametrize("count", [1, 3])
def test_gaussians_in_one_place_moved_to_map_coordinates_keep_their_digits(
    octasplat, make_scene, tmp_path, count
) -> None:
    lone, far, back = tmp_path / "lone.ply", tmp_path / "far.ply", tmp_path / "back.ply"
    write_gaussian_ply(make_scene(1).select(np.zeros(count, np.int64)), lone)
    away = [str(value + 0.0625) for value in ORIGIN]
    assert octasplat("transform", lone, "--translate", *away, "-o", far).exit_code == 0
    np.testing.assert_allclose(user_positions(far) - ORIGIN - 0.0625, user_positions(lone), atol=1e-5)
    home = [str(-value - 0.0625) for value in ORIGIN]
    assert octasplat("transform", far, "--translate", *home, "-o", back).exit_code == 0
    np.testing.assert_allclose(user_positions(back), user_positions(lone), atol=1e-5)
    # a step aside keeps the coordinates as they are
    assert octasplat("transform", lone, "--translate", "5", "0", "0", "-o", back).exit_code == 0
    assert read_metadata(back).origin_world == NO_ORIGIN
