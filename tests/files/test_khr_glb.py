import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.files import (
    ExportOptions,
    export_scene,
    glb_container,
    importer_for,
    khr_glb,
    mesh_glb,
    read_mesh,
    read_scene,
)
from octasplat.engine.files.compressed_khr_glb import write_compressed_glb
from octasplat.engine.gaussians.frames import rotation_matrices
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.gaussians.octagon import octagon_corners_world, octagon_radii
from octasplat.engine.gaussians.rows import row_arrays
from octasplat.engine.gaussians.spherical_harmonics import sh_basis

Make = Callable[..., FlatGaussians]
KHR = "KHR_gaussian_splatting"
TYPES = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
HALF_TURN = np.diag([1.0, -1.0, -1.0])


def parts(path: Path) -> tuple[dict[str, Any], bytes]:
    data = path.read_bytes()
    assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
    length, kind = struct.unpack_from("<I4s", data, 12)
    size, binary = struct.unpack_from("<I4s", data, 20 + length)
    assert (kind, binary, length % 4, size % 4) == (b"JSON", b"BIN\0", 0, 0)
    assert 28 + length + size == len(data)
    return json.loads(data[20 : 20 + length]), data[28 + length :]


def join(path: Path, document: dict[str, Any], binary: bytes) -> Path:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(binary), len(text), b"JSON")
    path.write_bytes(head + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary)
    return path


def attribute(document: dict[str, Any], binary: bytes, name: str) -> np.ndarray:
    accessor = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"][name]]
    view = document["bufferViews"][accessor["bufferView"]]
    kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
    width = TYPES[accessor["type"]]
    raw = binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    values = np.frombuffer(raw, kind).reshape(-1, width)
    assert len(values) == accessor["count"]
    return values


def test_scene_beyond_the_limit_of_a_file_is_split_in_its_order(
    make_scene: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_scene(5000)
    (whole,) = export_scene(scene, tmp_path / "whole.splats.glb")
    limit = int(0.45 * whole.stat().st_size)
    monkeypatch.setattr(glb_container, "MAX_BYTES", limit)
    written = export_scene(scene, tmp_path / "a.splats.glb")
    assert [path.name for path in written] == [
        "a.splats.glb",
        "a.splats.part2.glb",
        "a.splats.part3.glb",
    ]
    assert all(path.stat().st_size <= limit for path in written)
    extras = [parts(path)[0]["asset"]["extras"]["octasplat_part"] for path in written]
    assert extras == [[1, 3], [2, 3], [3, 3]] and "extras" not in parts(whole)[0]["asset"]
    together = concatenate([read_scene(path)[0] for path in written])
    expected = read_scene(whole)[0]
    for name, array in row_arrays(expected).items():
        np.testing.assert_array_equal(row_arrays(together)[name], array)


@pytest.mark.parametrize("name", ["a.splats.glb", "a.glb"])
def test_first_of_several_files_is_there_when_all_are(
    make_scene: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """A run that goes on takes a file that is there for written."""
    scene = make_scene(5000)
    (path,) = export_scene(scene, tmp_path / name)  # of an earlier export, which held all
    monkeypatch.setattr(glb_container, "MAX_BYTES", int(0.45 * path.stat().st_size))
    left = [2]

    def write_until_stopped(*arguments: Any) -> None:
        left[0] -= 1
        if left[0] < 0:
            raise KeyboardInterrupt
        write_glb(*arguments)

    write_glb = glb_container.write_glb
    for module in (khr_glb, mesh_glb):
        monkeypatch.setattr(module, "write_glb", write_until_stopped)
    with pytest.raises(KeyboardInterrupt):
        export_scene(scene, path)
    assert sorted(found.name for found in tmp_path.iterdir()) == [
        f"{path.stem}.part2.glb", f"{path.stem}.part3.glb",
    ]  # fmt: skip


def test_attributes_of_other_lengths_are_refused(make_scene: Make, tmp_path: Path) -> None:
    export_scene(make_scene(30), tmp_path / "a.splats.glb")
    document, binary = parts(tmp_path / "a.splats.glb")
    document["accessors"][3]["count"] = 20
    join(tmp_path / "b.glb", document, binary)
    with pytest.raises(SceneFileError, match="differ in length"):
        read_scene(tmp_path / "b.glb")


def test_attributes_are_those_of_the_specification(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(70000)  # more than one block; degree 1
    export_scene(scene, tmp_path / "a.splats.glb")
    document, binary = parts(tmp_path / "a.splats.glb")
    primitive = document["meshes"][0]["primitives"][0]
    assert document["extensionsUsed"] == [KHR] and "extensionsRequired" not in document
    assert primitive["mode"] == 0
    assert primitive["extensions"][KHR]["kernel"] == "ellipse"
    assert primitive["extensions"][KHR]["colorSpace"] == "srgb_rec709_display"
    assert set(primitive["attributes"]) == {
        "POSITION", "COLOR_0", f"{KHR}:ROTATION", f"{KHR}:SCALE", f"{KHR}:OPACITY",
        f"{KHR}:SH_DEGREE_0_COEF_0", *(f"{KHR}:SH_DEGREE_1_COEF_{n}" for n in range(3)),
    }  # fmt: skip
    positions = attribute(document, binary, "POSITION")
    np.testing.assert_array_equal(positions, scene.means_world * np.float32([1, -1, -1]))
    bounds = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(np.float32(bounds["min"]), positions.min(axis=0))
    np.testing.assert_array_equal(np.float32(bounds["max"]), positions.max(axis=0))
    rotation = attribute(document, binary, f"{KHR}:ROTATION")
    np.testing.assert_allclose(np.linalg.norm(rotation, axis=1), 1, atol=1e-6)
    scale = attribute(document, binary, f"{KHR}:SCALE")
    np.testing.assert_array_equal(scale[:, 0], np.float32(1e-5))
    np.testing.assert_array_equal(scale[:, 1:], scene.scales)
    frames = rotation_matrices(rotation[:, [3, 0, 1, 2]].astype(np.float64))
    covariance = np.einsum("nij,nj,nkj->nik", frames[:, :, 1:], scale[:, 1:] ** 2, frames[:, :, 1:])
    ours = HALF_TURN @ scene.rotations.astype(np.float64)[:, :, 1:]
    np.testing.assert_allclose(
        covariance, np.einsum("nij,nj,nkj->nik", ours, scene.scales**2, ours), atol=1e-5
    )
    np.testing.assert_array_equal(attribute(document, binary, f"{KHR}:OPACITY")[:, 0], scene.opacities)
    color = attribute(document, binary, "COLOR_0") / 255
    linear = srgb_to_linear(np.clip(scene.base_rgb_srgb, 0, 1))
    np.testing.assert_allclose(color[:, :3], linear, atol=0.502 / 255)


def test_colors_seen_from_a_direction_turn_with_the_scene(make_scene: Make, tmp_path: Path) -> None:
    base = make_scene(50)
    sh = np.random.default_rng(0).standard_normal((50, 16, 3)).astype(np.float32)
    scene = FlatGaussians(base.means_world, base.quats_wxyz, base.log_scales, base.opacity_logits, sh)
    export_scene(scene, tmp_path / "a.splats.glb")
    document, binary = parts(tmp_path / "a.splats.glb")
    names = [f"{KHR}:SH_DEGREE_{d}_COEF_{n}" for d in range(4) for n in range(2 * d + 1)]
    written = np.stack([attribute(document, binary, name) for name in names], axis=1)
    directions = np.random.default_rng(1).standard_normal((50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ours = np.einsum("nk,nkc->nc", sh_basis(directions, 3), sh)
    theirs = np.einsum("nk,nkc->nc", sh_basis(directions @ HALF_TURN, 3), written)
    np.testing.assert_allclose(theirs, ours, atol=1e-5)


def test_node_transforms_are_applied(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(40)
    export_scene(scene, tmp_path / "a.splats.glb")
    document, binary = parts(tmp_path / "a.splats.glb")
    quarter = [0.0, float(np.sqrt(0.5)), 0.0, float(np.sqrt(0.5))]  # about y
    document["nodes"] = [
        {"children": [1], "rotation": quarter, "translation": [1.0, 2.0, 3.0]},
        {"mesh": 0, "scale": [2.0, 2.0, 2.0]},
    ]
    back, _ = read_scene(join(tmp_path / "b.glb", document, binary))
    turn = HALF_TURN @ np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]) @ HALF_TURN
    expected = 2 * scene.means_world @ turn.T + HALF_TURN @ (1.0, 2.0, 3.0)
    np.testing.assert_allclose(back.means_world, expected, atol=1e-5)
    np.testing.assert_allclose(back.scales, 2 * scene.scales, rtol=1e-5)
    cosines = np.einsum("nij,nij->nj", back.rotations, turn @ scene.rotations.astype(np.float64))
    np.testing.assert_allclose(np.abs(cosines), 1, atol=1e-5)
    direction = np.array([[0.6, 0.0, -0.8]])
    np.testing.assert_allclose(
        np.einsum("mk,nkc->nc", sh_basis(direction @ turn.T, 1), back.sh),
        np.einsum("mk,nkc->nc", sh_basis(direction, 1), scene.sh),
        atol=1e-5,
    )
    document["nodes"][1]["scale"] = [2.0, 1.0, 2.0]
    with pytest.raises(SceneFileError, match="scales them unevenly"):
        read_scene(join(tmp_path / "b.glb", document, binary))


def test_several_primitives_and_quantised_attributes(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(30)
    export_scene(scene, tmp_path / "a.splats.glb")
    document, binary = parts(tmp_path / "a.splats.glb")
    first = document["meshes"][0]["primitives"][0]
    opacity = np.rint(scene.opacities * 65535).astype("<u2")
    rotation = np.rint(attribute(document, binary, f"{KHR}:ROTATION") * 32767).astype("<i2")
    padded = np.zeros((30, 2), "<u2")
    padded[:, 0] = opacity
    document["bufferViews"] += [
        {"buffer": 0, "byteOffset": len(binary), "byteLength": 120, "byteStride": 4},
        {"buffer": 0, "byteOffset": len(binary) + 120, "byteLength": 240},
    ]
    views = len(document["bufferViews"])
    document["accessors"] += [
        {"bufferView": views - 2, "componentType": 5123, "normalized": True, "count": 30, "type": "SCALAR"},
        {"bufferView": views - 1, "componentType": 5122, "normalized": True, "count": 30, "type": "VEC4"},
    ]
    accessors = len(document["accessors"])
    own = {f"{KHR}:OPACITY": accessors - 2, f"{KHR}:ROTATION": accessors - 1}
    kept = {name: number for name, number in first["attributes"].items() if "DEGREE_1" not in name}
    document["meshes"][0]["primitives"] = [
        first,
        {**first, "attributes": {**kept, **own}},
        {"attributes": {}},
    ]
    path = join(tmp_path / "b.glb", document, binary + padded.tobytes() + rotation.tobytes())
    back, report = read_scene(path)
    assert (report.count, report.sh_degree, report.flattened) == (60, 1, 0)
    np.testing.assert_array_equal(back.means_world[30:], back.means_world[:30])
    np.testing.assert_array_equal(back.sh[30:, 1:], 0)
    np.testing.assert_allclose(back.opacities[30:], scene.opacities, atol=1e-5)
    np.testing.assert_allclose(back.rotations[30:], back.rotations[:30], atol=2e-4)


def test_khr_glb_linear_colors_are_converted_with_warning(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(30)
    export_scene(scene, tmp_path / "a.splats.glb")
    document, binary = parts(tmp_path / "a.splats.glb")
    document["meshes"][0]["primitives"][0]["extensions"][KHR]["colorSpace"] = "lin_rec709_display"
    back, report = read_scene(join(tmp_path / "b.glb", document, binary))
    assert back.sh_degree == 0 and "linear" in report.notes[0]
    inside = (scene.base_rgb_srgb > 0.05) & (scene.base_rgb_srgb < 1)
    again = srgb_to_linear(back.base_rgb_srgb)
    np.testing.assert_allclose(again[inside], scene.base_rgb_srgb[inside], atol=1e-5)


def test_linear_colors_of_compressed_splats_are_converted_with_warning(
    make_scene: Make, tmp_path: Path
) -> None:
    scene = make_scene(30)
    write_compressed_glb(scene, tmp_path / "a.glb", np.zeros(3))
    document, binary = parts(tmp_path / "a.glb")
    document["meshes"][0]["primitives"][0]["extensions"][KHR]["colorSpace"] = "lin_rec709_display"
    linear, report = read_scene(join(tmp_path / "b.glb", document, binary))
    display, _ = read_scene(tmp_path / "a.glb")
    assert linear.sh_degree == 0 and "linear" in report.notes[0]
    inside = (display.base_rgb_srgb > 0.05) & (display.base_rgb_srgb < 1)
    again = srgb_to_linear(linear.base_rgb_srgb)
    np.testing.assert_allclose(again[inside], display.base_rgb_srgb[inside], atol=1e-5)


def test_another_kernel_is_refused_and_an_unknown_color_space_told(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(30)
    export_scene(scene, tmp_path / "a.splats.glb")
    document, binary = parts(tmp_path / "a.splats.glb")
    splats = document["meshes"][0]["primitives"][0]["extensions"][KHR]
    splats["colorSpace"] = "BT.709-sRGB"  # of a draft
    back, report = read_scene(join(tmp_path / "b.glb", document, binary))
    assert report.notes == (
        "Its color space BT.709-sRGB is not known; its colors were taken for srgb_rec709_display.",
    )
    np.testing.assert_array_equal(back.sh, scene.sh)
    splats["kernel"] = "surflet"
    with pytest.raises(SceneFileError, match=r"b\.glb: .* the kernel surflet, which is not read"):
        read_scene(join(tmp_path / "b.glb", document, binary))
    del splats["kernel"], splats["colorSpace"]  # as in earlier drafts
    back, report = read_scene(join(tmp_path / "c.glb", document, binary))
    assert report.notes == ()
    np.testing.assert_array_equal(back.sh, scene.sh)


def test_khr_glb_without_gaussians_is_refused(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(30)
    export_scene(scene, tmp_path / "octagons.glb")
    document, binary = parts(tmp_path / "octagons.glb")
    document["asset"]["extras"] = {}
    join(tmp_path / "mesh.glb", document, binary)
    assert importer_for(tmp_path / "mesh.glb").name == "khr-glb"
    with pytest.raises(SceneFileError, match=r"mesh\.glb: holds no splats .*octasplat edit"):
        read_scene(tmp_path / "mesh.glb")
    export_scene(scene, tmp_path / "a.splats.glb")
    document, binary = parts(tmp_path / "a.splats.glb")
    whole = (tmp_path / "a.splats.glb").read_bytes()
    for cut in (6, 25, len(whole) // 2, len(whole) - 4):
        (tmp_path / "b.glb").write_bytes(whole[:cut])
        with pytest.raises(SceneFileError, match=r"b\.glb: "):
            read_scene(tmp_path / "b.glb")
    splats = document["meshes"][0]["primitives"][0]
    splats["extensions"][KHR]["extensions"] = {"KHR_gaussian_splatting_compression_x": {}}
    with pytest.raises(SceneFileError, match="compression_x, which is not read"):
        read_scene(join(tmp_path / "b.glb", document, binary))
    del splats["extensions"][KHR]["extensions"], splats["attributes"][f"{KHR}:SCALE"]
    with pytest.raises(SceneFileError, match=r"damaged or not understood .*SCALE"):
        read_scene(join(tmp_path / "b.glb", document, binary))
    document, binary = parts(tmp_path / "a.splats.glb")
    document["accessors"][0]["count"] = 10**9
    with pytest.raises(SceneFileError, match="damaged or not understood"):
        read_scene(join(tmp_path / "b.glb", document, binary))


def test_attributes_of_other_programs_become_channels_where_they_are_wanted(
    make_scene: Make, tmp_path: Path
) -> None:
    scene = make_scene(30)
    albedo = np.random.default_rng(0).random((30, 3), np.float32)
    export_scene(scene.with_channels({"albedo": albedo}), tmp_path / "a.splats.glb")
    document, binary = parts(tmp_path / "a.splats.glb")
    np.testing.assert_array_equal(attribute(document, binary, "_ALBEDO"), albedo)
    document["asset"]["extras"] = "written by somebody else"
    foreign = join(tmp_path / "b.glb", document, binary)
    assert read_scene(foreign)[0].channels.widths == {}
    np.testing.assert_array_equal(read_scene(foreign, channels="all")[0].channels["albedo"], albedo)
    with pytest.raises(SceneFileError, match=r"b\.glb: has no channel 'label'; it has albedo"):
        read_scene(foreign, channels=("label",))


def test_primitives_without_a_channel_get_zeros(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(10).with_channels({"label": np.arange(10, dtype=np.float32)[:, None]})
    export_scene(scene, tmp_path / "a.splats.glb")
    document, binary = parts(tmp_path / "a.splats.glb")
    primitives = document["meshes"][0]["primitives"]
    bare = json.loads(json.dumps(primitives[0]))
    del bare["attributes"]["_LABEL"]
    primitives.insert(0, bare)
    back, _ = read_scene(join(tmp_path / "b.glb", document, binary))
    assert back.channels["label"][:, 0].tolist() == [0.0] * 10 + list(range(10))
    primitives[1]["attributes"]["_LABEL"] = document["meshes"][0]["primitives"][1]["attributes"]["POSITION"]
    document["asset"]["extras"] = {"octasplat_channels": {"label": "many"}}
    with pytest.raises(SceneFileError, match="its glTF is damaged"):
        read_scene(join(tmp_path / "c.glb", document, binary))


def test_octagons_are_a_scene_with_one_color_each(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(300)
    label = np.arange(300, dtype=np.float32)[:, None]
    export_scene(scene.with_channels({"label": label}), tmp_path / "mesh.glb", ExportOptions(chunks=4))
    back, report = read_scene(tmp_path / "mesh.glb")
    kept = scene.select(octagon_radii(scene.opacities) > 0)
    assert 0 < len(back) == len(kept) < 300 and report.flattened == 0
    assert "one color" in report.notes[0] and f"{300 - len(kept)} fainter" in report.notes[1]
    np.testing.assert_array_equal(back.channels["label"], label[octagon_radii(scene.opacities) > 0])
    np.testing.assert_allclose(back.means_world, kept.means_world, atol=2e-6)
    np.testing.assert_allclose(back.scales, kept.scales, rtol=1e-3)
    np.testing.assert_allclose(back.opacities, kept.opacities, rtol=1e-5)
    np.testing.assert_allclose(back.base_rgb_srgb, kept.base_rgb_srgb.clip(0, 1), atol=1e-5)
    radii = octagon_radii(kept.opacities)
    corners = octagon_corners_world(kept, radii)
    np.testing.assert_allclose(octagon_corners_world(back, radii), corners, atol=1e-4 * kept.scales.max())


def test_cores_are_the_same_octagons_once_more_and_are_passed_over(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(60)
    export_scene(scene, tmp_path / "plain.glb", ExportOptions(chunks=2))
    export_scene(scene, tmp_path / "cores.glb", ExportOptions(chunks=2, cores=0.3))
    document, _ = parts(tmp_path / "cores.glb")
    for mesh in document["meshes"]:
        solid, blended = mesh["primitives"]
        assert solid["attributes"] == blended["attributes"] and solid["indices"] == blended["indices"]
        materials = [document["materials"][each["material"]] for each in (solid, blended)]
        assert [material["alphaMode"] for material in materials] == ["MASK", "BLEND"]
        assert materials[0]["alphaCutoff"] == pytest.approx(0.3)
    one, other = (read_scene(tmp_path / name)[0] for name in ("plain.glb", "cores.glb"))
    np.testing.assert_array_equal(one.means_world, other.means_world)
    assert len(read_mesh(tmp_path / "cores.glb")) == len(read_mesh(tmp_path / "plain.glb"))


def test_edited_octagon_glb_is_refused_as_scene(make_scene: Make, tmp_path: Path) -> None:
    export_scene(make_scene(40), tmp_path / "mesh.glb", ExportOptions(chunks=1))
    document, binary = parts(tmp_path / "mesh.glb")
    document["nodes"][1]["scale"] = [1.0, 1.1, 1.0]
    with pytest.raises(SceneFileError, match=r"b\.glb: .*octasplat edit --mesh"):
        read_scene(join(tmp_path / "b.glb", document, binary))
