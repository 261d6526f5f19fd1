"""The commands, as a user calls them."""

import json
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.files import export_scene, read_mesh, read_metadata, write_surface
from octasplat.engine.files.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from octasplat.engine.gaussians.affine import transform_gaussians
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_metadata import SceneMetadata
from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from tests.support.edit_scenes import assert_same, cube

Make = Callable[..., FlatGaussians]


@pytest.fixture
def scene(make_scene: Make, tmp_path: Path) -> Path:
    write_gaussian_ply(make_scene(150), tmp_path / "scene.ply")
    return tmp_path / "scene.ply"


def read(path: Path) -> FlatGaussians:
    return read_gaussian_ply(path)[0]


def write_obj(path: Path, vertices: np.ndarray, triangles: np.ndarray) -> None:
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in vertices]
    path.write_text("\n".join(lines + [f"f {a} {b} {c}" for a, b, c in triangles + 1]) + "\n")


def test_edit_without_an_edit(octasplat, scene: Path, tmp_path: Path) -> None:
    assert octasplat("export", scene, tmp_path / "mesh.ply").exit_code == 0
    report = tmp_path / "report.json"
    result = octasplat(
        "edit", scene, "--mesh", tmp_path / "mesh.ply", "-o", tmp_path / "out.ply", "--report", report
    )
    assert result.exit_code == 0, result.output
    assert "0 Gaussians moved, 150 did not" in result.stdout
    assert (tmp_path / "out.ply").read_bytes() == scene.read_bytes()
    (counts,) = json.loads(report.read_text())
    assert counts["unmoved"] == 150 and counts["matched_by"] == "ids"


def test_edits_keep_scene_metadata(octasplat, make_scene: Make, tmp_path: Path) -> None:
    scene, facts = make_scene(150), SceneMetadata(near_world=0.25, pixel_rad=0.002, turned_beyond=0.5)
    channels = {"albedo": np.full((150, 3), 0.5, np.float32), "metallic": np.ones((150, 1), np.float32)}
    lit = scene.with_channels(channels | {"roughness": channels["metallic"]})
    source, out = tmp_path / "scene.ply", tmp_path / "out.ply"
    write_gaussian_ply(lit, source, facts=facts)
    assert octasplat("export", source, tmp_path / "mesh.ply").exit_code == 0
    cube_obj = tmp_path / "cube.obj"
    write_obj(cube_obj, *cube(2, 4.0))
    for command in (
        ("crop", source, "--where", "opacity > 0", "-o", out),
        ("clean", source, "--no-floaters", "-o", out),
        ("transform", source, "--rotate", "x", 30, "--scale", -1, "-o", out),
        ("edit", source, "--mesh", tmp_path / "mesh.ply", "-o", out),
        ("deform", source, "--proxy", cube_obj, "--deformed", cube_obj, "--reach", 9, "-o", out),
        ("material", source, "--set", "metallic=0", "-o", out),
        ("export", source, out),
        ("import", source, out),
        ("merge", source, source, "-o", out),
    ):
        done = octasplat(*command)
        assert done.exit_code == 0, done.output
        found = read_metadata(out)
        assert astuple(found)[:3] == pytest.approx(astuple(facts)[:3], rel=1e-12), command
        assert found.origin_world == (0.0, 0.0, 0.0)
        out.unlink()
    assert octasplat("transform", source, "--scale", 2, "-o", out).exit_code == 0
    assert astuple(read_metadata(out))[:3] == pytest.approx((0.5, 0.002, 0.5), rel=1e-12)
    # What has no materials does not ask which way its normals point; nothing may be hidden that one shows.
    write_gaussian_ply(scene, tmp_path / "plain.ply", facts=SceneMetadata(pixel_rad=0.001))
    assert octasplat("merge", source, tmp_path / "plain.ply", "-o", out).exit_code == 0
    assert read_metadata(out) == SceneMetadata(0.0, 0.001, 0.5)
    write_gaussian_ply(lit, tmp_path / "plain.ply")
    assert octasplat("merge", source, tmp_path / "plain.ply", "-o", out).exit_code == 0
    assert read_metadata(out) == SceneMetadata()


def test_edit_of_a_sequence_in_the_order_of_its_numbers(octasplat, scene: Path, tmp_path: Path) -> None:
    g = read(scene)
    frames = tmp_path / "frames"
    for number in (1, 2, 10):
        shifted = g.copy()
        shifted.means_world += np.float32([number, 0, 0])
        export_scene(shifted, frames / f"f{number}.ply", format="mesh-ply")
    octasplat_edit = ("edit", scene, "--mesh", frames / "*.ply", "--axes", "x0", "-q", "-o")
    result = octasplat(*octasplat_edit, tmp_path / "out" / "%03d.ply")
    assert result.exit_code == 0, result.output
    assert result.output == ""
    for place, number in enumerate((1, 2, 10)):
        moved = read(tmp_path / "out" / f"{place:03d}.ply")
        np.testing.assert_allclose(moved.means_world, g.means_world + np.float32([number, 0, 0]), atol=2e-6)
    assert octasplat(*octasplat_edit, tmp_path / "named.ply").exit_code == 0
    assert (tmp_path / "named_0002.ply").exists()
    assert octasplat(*octasplat_edit, tmp_path / "folder").exit_code == 0
    assert (tmp_path / "folder" / "f10.ply").exists()


def test_edit_reports_rotated_axes(octasplat, scene: Path, tmp_path: Path) -> None:
    octasplat("export", scene, tmp_path / "mesh.obj")
    mesh = read_mesh(tmp_path / "mesh.obj")
    write_obj(tmp_path / "turned.obj", mesh.vertices[:, [0, 2, 1]] * [1, 1, -1], mesh.triangles)
    result = octasplat("edit", scene, "--mesh", tmp_path / "turned.obj", "-o", tmp_path / "out.ply")
    assert result.exit_code == 0, result.output
    assert result.stderr.startswith("Warning: ") and "--axes x0" in result.stderr
    np.testing.assert_allclose(read(tmp_path / "out.ply").means_world, read(scene).means_world, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--mesh", "none*.ply", "-o", "out.ply"), "no file matches"),
        (("--mesh", "none.ply", "-o", "out.ply"), "none.ply: cannot be read"),
        (("--mesh", "mesh.ply", "-o", "out.xyz"), "no export format"),
        (("--mesh", "mesh.ply", "-o", "mesh.ply"), "would overwrite"),
        (("--mesh", "mesh.ply", "-o", "scene.ply"), "would overwrite"),
        (("--mesh", "mesh.ply", "-o", "%s%d.ply"), "is no pattern"),
        (("--mesh", "scene.ply", "-o", "out.ply"), "is a file of Gaussians"),
        (("--mesh", "mesh.fbx", "-o", "out.ply"), "save it as .glb, .ply or .obj"),
    ],
)
def test_edit_refuses_in_one_sentence(
    octasplat, scene: Path, tmp_path: Path, monkeypatch, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    octasplat("export", "scene.ply", "mesh.ply")
    (tmp_path / "mesh.fbx").touch()
    before = scene.read_bytes()
    result = octasplat("edit", "scene.ply", *arguments)
    assert result.exit_code == 1
    assert message in result.stderr and result.stderr.count("\n") == 1
    assert scene.read_bytes() == before and not (tmp_path / "out.ply").exists()


@pytest.mark.parametrize("method", ["nearest", "mvc"])
def test_deform_command_follows_mesh(octasplat, scene: Path, tmp_path: Path, method: str) -> None:
    vertices, triangles = cube(3)
    write_obj(tmp_path / "rest.obj", vertices, triangles)
    write_obj(tmp_path / "up1.obj", vertices + np.array([0, 0, 1.0]), triangles)
    write_obj(tmp_path / "up2.obj", vertices + np.array([0, 0, 2.0]), triangles)
    result = octasplat(
        "deform", scene, "--proxy", tmp_path / "rest.obj", "--deformed", tmp_path / "up*.obj",
        "--method", method, "--reach", "inf", "-o", tmp_path / "out.ply",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "moves 150 of 150 Gaussians" in result.stdout
    for number in (0, 1):
        moved = read(tmp_path / f"out_000{number}.ply").means_world
        np.testing.assert_allclose(moved, read(scene).means_world + np.float32([0, 0, number + 1]), atol=1e-6)


def test_deform_by_a_surface_of_ours_follows_its_axes(octasplat, scene: Path, tmp_path: Path) -> None:
    vertices, triangles = cube(2, 4.0)
    shift = np.array([0.0, 1.0, 0.5])
    for name, points in (("rest", vertices), ("bent", vertices + shift)):
        mesh = TriangleMesh(points.astype(np.float32), triangles.astype(np.int32))
        write_surface(mesh, tmp_path / f"{name}.glb")  # y up, as glTF has it
    out = tmp_path / "out.ply"
    command = (
        "deform",
        scene,
        "--proxy",
        tmp_path / "rest.glb",
        "--deformed",
        tmp_path / "bent.glb",
        "-o",
        out,
    )
    result = octasplat(*command, "--method", "mvc")
    assert result.exit_code == 0, result.output
    assert "turned by x180" in result.stdout
    np.testing.assert_allclose(read(out).means_world, read(scene).means_world + shift, atol=1e-6)
    result = octasplat(*command, "--method", "mvc", "--axes", "x0")
    assert result.exit_code == 0 and "turned by" not in result.stdout
    np.testing.assert_allclose(read(out).means_world, read(scene).means_world - shift, atol=1e-6)


def test_deform_refuses_other_meshes_and_proxies_far_away(octasplat, scene: Path, tmp_path: Path) -> None:
    vertices, triangles = cube(2)
    write_obj(tmp_path / "rest.obj", vertices, triangles)
    write_obj(tmp_path / "other.obj", vertices, (triangles + 1) % len(vertices))
    write_obj(tmp_path / "far.obj", vertices + 50, triangles)
    write_obj(tmp_path / "open.obj", vertices, triangles[1:])
    for proxy, deformed, method, message in (
        ("rest", "other", "nearest", "the same vertices and faces"),
        ("far", "far", "nearest", "--axes x90"),
        ("open", "open", "mvc", "open.obj: The proxy is not closed"),
    ):
        result = octasplat(
            "deform", scene, "--proxy", tmp_path / f"{proxy}.obj", "--method", method,
            "--deformed", tmp_path / f"{deformed}.obj", "-o", tmp_path / "out.ply",
        )  # fmt: skip
        assert result.exit_code == 1 and message in result.stderr, result.output


def test_transform_crop_merge_clean(octasplat, scene: Path, tmp_path: Path) -> None:
    g = read(scene)
    turned, right, left, both = (tmp_path / f"{name}.ply" for name in ("turned", "right", "left", "both"))
    result = octasplat(
        "transform", scene, "-o", turned, "--up", "-y", "z", "--scale", 2, "--rotate", "z", 90,
        "--translate", 1, 0, 0,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    x, y, z = g.means_world.T  # -y to z: (x, z, -y); then 90 degrees about z: (-z, x, -y)
    np.testing.assert_allclose(
        read(turned).means_world, np.stack([1 - 2 * z, 2 * x, -2 * y], axis=-1), atol=1e-6
    )
    box = ("--box", 0, -9, -9, 9, 9, 9)
    assert octasplat("crop", scene, "-o", right, *box).exit_code == 0
    assert octasplat("crop", scene, "-o", left, *box, "--inverse").exit_code == 0
    assert_same(read(right), g.select(g.means_world[:, 0] >= 0))
    assert octasplat("crop", scene, "-o", left, "--where", "x < 0").exit_code == 0
    assert_same(read(left), g.select(g.means_world[:, 0] < 0))
    result = octasplat("merge", right, left, "-o", both, "--sh-degree", 1)
    assert result.exit_code == 0 and "150 Gaussians" in result.stdout
    assert len(read(both)) == 150 and read(both).sh_degree == 1
    result = octasplat("clean", both, "--dry-run", "--min-opacity", 0.99, "--no-floaters")
    faint = int((g.opacities < 0.99).sum())
    assert result.exit_code == 0 and f"{faint} too faint" in result.stdout
    assert octasplat("clean", both, "-o", tmp_path / "clean.ply", "--min-opacity", 0.9).exit_code == 0
    assert read(tmp_path / "clean.ply").opacities.min() >= 0.9


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("transform", "scene.ply", "-o", "out.ply"), 2, "Say what to do"),
        (("transform", "scene.ply", "-o", "out.ply", "--scale", "0"), 1, "flattens space"),
        (("crop", "scene.ply", "-o", "out.ply"), 2, "Say what to keep"),
        (
            ("crop", "scene.ply", "-o", "out.ply", "--sphere", "99", "0", "0", "1"),
            1,
            "octasplat info tells where",
        ),
        (("crop", "scene.ply", "-o", "out.ply", "--box", *"110", *"001"), 1, "smallest"),
        (("merge", "scene.ply", "-o", "out.ply"), 2, "at least two"),
        (("clean", "scene.ply"), 2, "--dry-run"),
        (("clean", "scene.ply", "-o", "out.ply", "--min-scale", "9"), 1, "octasplat info tells its sizes"),
    ],
)
def test_edit_commands_invalid_arguments_are_refused(
    octasplat, scene: Path, monkeypatch, arguments, code: int, message: str
) -> None:
    monkeypatch.chdir(scene.parent)
    result = octasplat(*arguments)
    assert result.exit_code == code and message in result.stderr, result.output
    assert not Path("out.ply").exists()


@pytest.mark.parametrize("turned_over", [False, True])
def test_deform_by_a_mirrored_proxy(octasplat, scene: Path, tmp_path: Path, turned_over: bool) -> None:
    vertices, triangles = cube(2)
    write_obj(tmp_path / "rest.obj", vertices, triangles)
    faces = triangles[:, ::-1] if turned_over else triangles  # as Blender exports an object of scale -1
    write_obj(tmp_path / "mirrored.obj", vertices * [-1, 1, 1], faces)
    result = octasplat(
        "deform", scene, "--proxy", tmp_path / "rest.obj", "--deformed", tmp_path / "mirrored.obj",
        "--reach", "inf", "-o", tmp_path / "out.ply", "--report", tmp_path / "report.json",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "150 mirrored with the proxy" in result.stdout
    moved, exact = (
        read(tmp_path / "out.ply"),
        transform_gaussians(read(scene), np.diag([-1.0, 1.0, 1.0, 1.0])),
    )
    np.testing.assert_allclose(moved.means_world, exact.means_world, atol=1e-6)
    np.testing.assert_allclose(moved.sh, exact.sh, atol=1e-4)
