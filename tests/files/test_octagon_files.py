"""The octagon PLY and the OBJ, read back by means other than their writers'."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

import octasplat.engine.files.mesh_obj as obj_module
from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.ply_container import read_ply
from octasplat.engine.files import ExportOptions, export_scene, octagon_batches, read_scene
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import (
    CHI2_2_99,
    CHI2_3_99,
    frames_from_octagons,
    octagon_corners_world,
    octagon_radii,
    octagon_triangles,
)

Make = Callable[..., FlatGaussians]


def expected_uv(radii: np.ndarray, q: float) -> np.ndarray:
    angles = 2 * np.pi * np.arange(8) / 8
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    return 0.5 + 0.5 * (radii / np.sqrt(q))[:, None, None] * circle


def test_mesh_ply_holds_every_octagon_once(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(300)
    options = ExportOptions(q=CHI2_3_99)
    export_scene(scene, tmp_path / "mesh.ply", options)
    header, tables = read_ply(tmp_path / "mesh.ply", ["vertex", "face"])
    radii = octagon_radii(scene.opacities, options.q)
    ids = np.flatnonzero(radii > 0)
    assert 0 < len(ids) < 300
    assert f"octasplat_q {CHI2_3_99!r}" in header.comments
    vertex = tables["vertex"].reshape(-1, 8)
    np.testing.assert_array_equal(vertex["gid"], np.repeat(ids[:, None], 8, axis=1))
    np.testing.assert_array_equal(vertex["corner"], np.broadcast_to(np.arange(8), vertex.shape))
    np.testing.assert_array_equal(vertex["radius"], np.repeat(radii[ids, None], 8, axis=1))
    corners = np.stack([vertex["x"], vertex["y"], vertex["z"]], axis=-1)
    np.testing.assert_array_equal(corners, octagon_corners_world(scene, radii)[ids])
    uv = np.stack([vertex["s"], vertex["t"]], axis=-1)
    np.testing.assert_allclose(uv, expected_uv(radii[ids], options.q), atol=1e-6)
    colors = np.stack([vertex[name] for name in ("red", "green", "blue", "alpha")], axis=-1)
    rgba = np.concatenate([np.clip(scene.base_rgb_srgb, 0, 1), scene.opacities[:, None]], axis=1)[ids]
    assert np.abs(colors / 255.0 - rgba[:, None]).max() <= 0.5 / 255 + 1e-6
    np.testing.assert_array_equal(tables["face"]["vertex_indices"], octagon_triangles(len(ids)))


def test_mesh_ply_comes_back_to_the_same_gaussians(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(100, seed=1)
    export_scene(scene, tmp_path / "mesh.ply")
    vertex = read_ply(tmp_path / "mesh.ply", ["vertex"])[1]["vertex"].reshape(-1, 8)
    ids = vertex["gid"][:, 0].astype(int)
    corners = np.stack([vertex["x"], vertex["y"], vertex["z"]], axis=-1)
    means, _, log_scales, good = frames_from_octagons(corners, vertex["radius"][:, 0].copy())
    assert good.all()
    np.testing.assert_allclose(means, scene.means_world[ids], atol=1e-6)
    np.testing.assert_allclose(log_scales, scene.log_scales[ids], atol=1e-3)


def test_mesh_ply_is_a_scene_with_one_color_each(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(300)
    label = np.arange(300, dtype=np.float32)[:, None]
    export_scene(scene.with_channels({"label": label}), tmp_path / "mesh.ply")
    (tmp_path / "mesh.ply").rename(tmp_path / "anything.ply")  # what it holds decides, not its name
    back, report = read_scene(tmp_path / "anything.ply")
    shown = octagon_radii(scene.opacities) > 0
    kept = scene.select(shown)
    assert 0 < len(back) == len(kept) < 300 and report.flattened == 0
    assert "one color" in report.notes[0] and f"{300 - len(kept)} fainter" in report.notes[1]
    np.testing.assert_array_equal(back.channels["label"], label[shown])
    np.testing.assert_allclose(back.means_world, kept.means_world, atol=2e-6)
    np.testing.assert_allclose(back.scales, kept.scales, rtol=1e-3)
    np.testing.assert_allclose(back.opacities, kept.opacities, atol=0.51 / 255)
    np.testing.assert_allclose(back.base_rgb_srgb, kept.base_rgb_srgb.clip(0, 1), atol=0.51 / 255)


def test_edited_mesh_ply_is_refused_as_scene(make_scene: Make, tmp_path: Path) -> None:
    export_scene(make_scene(40), tmp_path / "mesh.ply")
    header, tables = read_ply(tmp_path / "mesh.ply", ["vertex", "face"])
    data = (tmp_path / "mesh.ply").read_bytes()
    for name, change in (("x", lambda v: v * np.float32(1.1)), ("gid", lambda v: v * 0)):
        vertex = tables["vertex"].copy()
        vertex[name][: 8 * 20] = change(vertex[name][: 8 * 20])
        start, size = header.data_offset, vertex.nbytes
        (tmp_path / "b.ply").write_bytes(data[:start] + vertex.tobytes() + data[start + size :])
        with pytest.raises(SceneFileError, match=r"b\.ply: .*octasplat edit --mesh"):
            read_scene(tmp_path / "b.ply")


def test_mesh_ply_of_more_than_one_batch(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(40000)
    export_scene(scene, tmp_path / "mesh.ply")
    tables = read_ply(tmp_path / "mesh.ply", ["vertex", "face"])[1]
    ids = np.flatnonzero(octagon_radii(scene.opacities) > 0)
    np.testing.assert_array_equal(tables["vertex"]["gid"][::8], ids)
    np.testing.assert_array_equal(tables["face"]["vertex_indices"], octagon_triangles(len(ids)))


def parse_obj(path: Path) -> dict[str, list[list[str]]]:
    lines: dict[str, list[list[str]]] = {}
    for line in path.read_text().splitlines():
        keyword, *words = line.split()
        lines.setdefault(keyword, []).append(words)
    return lines


def test_obj_holds_the_same_octagons(
    make_scene: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (obj_module, octagon_batches):
        monkeypatch.setattr(module, "BATCH_SIZE", 128)
    scene = make_scene(600)
    written = export_scene(scene, tmp_path / "fox.obj")
    assert [path.name for path in written] == ["fox.obj", "fox.mtl", "fox_alpha.png"]
    obj = parse_obj(written[0])
    radii = octagon_radii(scene.opacities)
    ids = np.flatnonzero(radii > 0)
    v = np.array(obj["v"], dtype=np.float64)
    np.testing.assert_array_equal(
        v[:, :3].astype(np.float32).reshape(-1, 8, 3), octagon_corners_world(scene, radii)[ids]
    )
    np.testing.assert_allclose(v[::8, 3:], np.clip(scene.base_rgb_srgb, 0, 1)[ids], atol=1e-5)
    np.testing.assert_array_equal(v[::8, 3:], v[7::8, 3:])
    uv = np.array(obj["vt"], dtype=np.float64).reshape(-1, 8, 2)
    np.testing.assert_allclose(uv, expected_uv(radii[ids], CHI2_2_99), atol=1e-6)
    faces = np.array([[corner.split("/") for corner in face] for face in obj["f"]], dtype=int)
    np.testing.assert_array_equal(faces[..., 0], octagon_triangles(len(ids)) + 1)
    np.testing.assert_array_equal(faces[..., 1], faces[..., 0])
    assert obj["mtllib"] == [["fox.mtl"]]
    material = parse_obj(written[1])
    assert material["newmtl"] == obj["usemtl"]
    assert material["map_d"] == [["fox_alpha.png"]]


def test_obj_texture_is_the_fall_off_as_grey(make_scene: Make, tmp_path: Path) -> None:
    _, _, texture = export_scene(
        make_scene(9), tmp_path / "a.obj", ExportOptions(q=6.0, falloff_texture_size=32)
    )
    pixels = oiio.ImageBuf(str(texture)).get_pixels(oiio.UINT8)
    assert pixels.shape == (32, 32, 1)
    x = (np.arange(32) + 0.5) / 16 - 1
    expected = np.exp(-0.5 * 6.0 * (x**2 + x[:, None] ** 2))
    np.testing.assert_allclose(pixels[..., 0] / 255.0, expected, atol=0.5 / 255 + 1e-9)


@pytest.mark.parametrize("name", ["a.obj", "a.mesh.ply"])
def test_trimesh_reads_the_same_octagons_colors_and_texture_coordinates(
    make_scene: Make, tmp_path: Path, name: str
) -> None:
    trimesh = pytest.importorskip("trimesh")
    scene = make_scene(200)
    export_scene(scene, tmp_path / name)
    mesh = trimesh.load(tmp_path / name, process=False, maintain_order=True)
    radii = octagon_radii(scene.opacities)
    ids = np.flatnonzero(radii > 0)
    np.testing.assert_array_equal(mesh.faces, octagon_triangles(len(ids)))
    np.testing.assert_array_equal(
        mesh.vertices.astype(np.float32).reshape(-1, 8, 3), octagon_corners_world(scene, radii)[ids]
    )
    np.testing.assert_allclose(
        mesh.visual.uv.reshape(-1, 8, 2), expected_uv(radii[ids], CHI2_2_99), atol=1e-6
    )
    colors = np.asarray(mesh.vertex_attributes["color"])[::8, :3].astype(np.float64)
    colors /= 255.0 if colors.max() > 1.0 else 1.0
    np.testing.assert_allclose(colors, np.clip(scene.base_rgb_srgb, 0, 1)[ids], atol=0.51 / 255)


def test_mesh_ply_holds_channels(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(40)
    albedo = np.random.default_rng(0).random((40, 3), np.float32)
    export_scene(scene.with_channels({"albedo": albedo}), tmp_path / "mesh.ply")
    header, tables = read_ply(tmp_path / "mesh.ply", ["vertex"])
    assert "octasplat_channel albedo 3" in header.comments
    vertex = tables["vertex"]
    found = np.stack([vertex[f"albedo_{place}"] for place in range(3)], axis=1)
    np.testing.assert_array_equal(found, albedo[vertex["gid"].astype(np.int64)])
