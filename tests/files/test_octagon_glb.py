import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.core.errors import ConfigError, SceneFileError
from octasplat.engine.edit.mesh_to_gaussians import recover_gaussians
from octasplat.engine.files import (
    ExportOptions,
    export_scene,
    glb_container,
    octagon_batches,
    read_mesh,
    read_scene,
)
from octasplat.engine.files.kd_split import kd_split
from octasplat.engine.files.octagon_glb_layout import OPAQUE_CUTOFF
from octasplat.engine.files.textures import radial_alpha
from octasplat.engine.gaussians.frames import rotation_matrices
from octasplat.engine.gaussians.materials import MATERIAL_WIDTHS
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import octagon_corners_world, octagon_radii

Make = Callable[..., FlatGaussians]
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


class Glb:
    """A GLB file taken apart by the letter of the specification."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        assert struct.unpack_from("<4sII", data) == (b"glTF", 2, len(data))
        length, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON" and length % 4 == 0
        self.json = json.loads(data[20 : 20 + length])
        size, kind = struct.unpack_from("<I4s", data, 20 + length)
        assert kind == b"BIN\0" and size % 4 == 0 and 28 + length + size == len(data)
        self.bin = data[28 + length :]
        assert self.json["buffers"] == [{"byteLength": size}]

    def view(self, index: int) -> bytes:
        view = self.json["bufferViews"][index]
        assert view["byteOffset"] % 4 == 0
        return self.bin[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]

    def accessor(self, index: int) -> np.ndarray:
        accessor = self.json["accessors"][index]
        kind = {5126: "<f4", 5125: "<u4"}[accessor["componentType"]]
        width = WIDTHS[accessor["type"]]
        values = np.frombuffer(self.view(accessor["bufferView"]), kind)[: accessor["count"] * width]
        assert len(values) == accessor["count"] * width
        return values.reshape(-1, width) if width > 1 else values

    def primitives(self) -> list[dict[str, np.ndarray]]:
        """Attributes and indices of every mesh, in the order of the nodes."""
        result = []
        for child in self.json["nodes"][0]["children"]:
            (primitive,) = self.json["meshes"][self.json["nodes"][child]["mesh"]]["primitives"]
            arrays = {name: self.accessor(index) for name, index in primitive["attributes"].items()}
            result.append(arrays | {"indices": self.accessor(primitive["indices"])})
        return result

    def texture(self, folder: Path) -> np.ndarray:
        png = folder / "texture.png"
        png.write_bytes(self.view(self.json["images"][0]["bufferView"]))
        as_stored = oiio.ImageSpec()
        as_stored["oiio:UnassociatedAlpha"] = 1
        return oiio.ImageBuf(str(png), 0, 0, as_stored).get_pixels(oiio.UINT8) / 255.0


def bilinear(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Sampling with linear filter and clamp to edge, as GPUs do it."""
    size = len(image)
    x = np.clip(uv * size - 0.5, 0, size - 1)
    low = np.minimum(x.astype(int), size - 2)
    f = (x - low)[..., None]
    u, v = low[:, 0], low[:, 1]
    top = image[v, u] * (1 - f[:, 0]) + image[v, u + 1] * f[:, 0]
    bottom = image[v + 1, u] * (1 - f[:, 0]) + image[v + 1, u + 1] * f[:, 0]
    return top * (1 - f[:, 1]) + bottom * f[:, 1]


@pytest.mark.parametrize("q", [4.0, 9.21, 11.345])
def test_texture_times_vertex_color_is_the_gaussian(make_scene: Make, tmp_path: Path, q: float) -> None:
    scene = make_scene(400)
    export_scene(scene, tmp_path / "a.glb", ExportOptions(q=q))
    glb = Glb(tmp_path / "a.glb")
    (arrays,) = glb.primitives()
    texture = glb.texture(tmp_path)
    np.testing.assert_array_equal(texture[..., :3], 1.0)
    triangles = arrays["indices"].reshape(-1, 3)
    weights = np.random.default_rng(0).dirichlet([0.7] * 3, size=len(triangles))

    def interpolate(name: str) -> np.ndarray:
        return np.einsum("tk,tkc->tc", weights, arrays[name].astype(np.float64)[triangles])

    ids = arrays["_GID"][triangles[:, 0]].astype(int)
    offsets = interpolate("POSITION") - scene.means_world[ids]
    local = np.einsum("tji,tj->ti", scene.rotations[ids].astype(np.float64), offsets)
    rho2 = np.sum((local[:, 1:] / scene.scales[ids]) ** 2, axis=1)
    assert rho2.max() > 0.9 * q
    color = interpolate("COLOR_0") * bilinear(texture, interpolate("TEXCOORD_0"))
    expected = scene.opacities[ids] * np.exp(-rho2 / 2)
    np.testing.assert_allclose(color[:, 3], expected, atol=0.003)
    linear = srgb_to_linear(np.clip(scene.base_rgb_srgb, 0, 1))[ids]
    np.testing.assert_allclose(color[:, :3], linear, atol=1e-6)


def test_texture_filtering_error_is_within_bound() -> None:
    uv = np.random.default_rng(0).uniform(0.02, 0.98, (5000, 2))
    q = 9.21
    exact = np.exp(-0.5 * q * np.sum((2 * uv - 1) ** 2, axis=1))
    for size in (128, 2048):
        error = np.abs(bilinear(radial_alpha(size, q)[..., None], uv)[:, 0] - exact).max()
        assert error < q / size**2  # two axes, each h^2 / 8 times the second derivative 4 Q


def test_chunks_hold_every_octagon_exactly_once(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(20000)
    export_scene(scene, tmp_path / "a.glb")
    parts = Glb(tmp_path / "a.glb").primitives()
    assert len(parts) == 64
    radii = octagon_radii(scene.opacities)
    corners = octagon_corners_world(scene, radii)
    seen: list[np.ndarray] = []
    for arrays in parts:
        ids = arrays["_GID"].reshape(-1, 8).astype(int)
        assert (ids == ids[:, :1]).all()
        seen.append(ids[:, 0])
        np.testing.assert_array_equal(arrays["POSITION"].reshape(-1, 8, 3), corners[ids[:, 0]])
        np.testing.assert_array_equal(
            arrays["_CORNER"].reshape(-1, 8), np.broadcast_to(np.arange(8), ids.shape)
        )
        indices = arrays["indices"].reshape(-1, 6, 3)
        first = 8 * np.arange(len(indices))[:, None]
        np.testing.assert_array_equal(indices[:, :, 0], np.broadcast_to(first, indices.shape[:2]))
        np.testing.assert_array_equal(indices[:, :, 1], first + np.arange(1, 7))
        np.testing.assert_array_equal(indices[:, :, 2], first + np.arange(2, 8))
    np.testing.assert_array_equal(np.sort(np.concatenate(seen)), np.flatnonzero(radii > 0))


def test_chunks_are_compact_and_of_equal_size() -> None:
    points = np.random.default_rng(0).uniform(0, 1, (64 * 300 + 5, 3)).astype(np.float32)
    chunks = kd_split(points, 64)
    assert len(chunks) == 64
    assert {len(chunk) for chunk in chunks} <= {300, 301}
    volumes = [float(np.prod(np.ptp(points[chunk], axis=0))) for chunk in chunks]
    assert sum(volumes) < 1.0 and max(volumes) < 3 / 64
    assert len(kd_split(points[:511], 64)) == 1
    assert len(kd_split(np.zeros((1024, 3), np.float32), 64)) == 4


def test_octagon_glb_json_has_required_fields(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(2000)
    export_scene(scene, tmp_path / "a.glb")
    glb = Glb(tmp_path / "a.glb")
    document = glb.json
    assert document["asset"]["generator"] == "octasplat"
    assert document["asset"]["extras"]["octasplat_gaussians"] == 2000
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]
    (material,) = document["materials"]
    assert material["alphaMode"] == "BLEND" and material["doubleSided"] is True
    assert material["extensions"] == {"KHR_materials_unlit": {}}
    assert document["samplers"] == [{"magFilter": 9729, "minFilter": 9729, "wrapS": 33071, "wrapT": 33071}]
    for primitive, arrays in zip(document["meshes"], glb.primitives(), strict=True):
        position = document["accessors"][primitive["primitives"][0]["attributes"]["POSITION"]]
        np.testing.assert_array_equal(np.float32(position["min"]), arrays["POSITION"].min(axis=0))
        np.testing.assert_array_equal(np.float32(position["max"]), arrays["POSITION"].max(axis=0))
    image_view = document["images"][0]["bufferView"]
    assert "target" not in document["bufferViews"][image_view]


def test_root_node_turns_y_down_into_y_up(make_scene: Make, tmp_path: Path) -> None:
    export_scene(make_scene(10), tmp_path / "a.glb")
    document = Glb(tmp_path / "a.glb").json
    assert document["scenes"][document["scene"]]["nodes"] == [0]
    x, y, z, w = document["nodes"][0]["rotation"]
    np.testing.assert_allclose(
        rotation_matrices(np.array([[w, x, y, z]]))[0], np.diag([1.0, -1.0, -1.0]), atol=1e-15
    )
    assert all(set(node) == {"name", "mesh"} for node in document["nodes"][1:])


def test_octagon_glb_ids_option_omits_ids(make_scene: Make, tmp_path: Path) -> None:
    export_scene(make_scene(600), tmp_path / "a.glb", ExportOptions(ids=False))
    primitives = Glb(tmp_path / "a.glb").primitives()
    assert primitives
    for arrays in primitives:
        assert set(arrays) == {"POSITION", "COLOR_0", "TEXCOORD_0", "indices"}


def test_scene_with_more_gaussians_than_numbers_is_written_without_them(
    make_scene: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_scene(60)
    monkeypatch.setattr(octagon_batches, "MAX_FLOAT_ID", 59)
    for name in ("a.glb", "a.mesh.ply"):
        with pytest.raises(SceneFileError, match=r"can number 59 Gaussians.*--no-ids"):
            export_scene(scene, tmp_path / name)
    export_scene(scene, tmp_path / "a.glb", ExportOptions(ids=False))
    export_scene(scene, tmp_path / "a.viewer.glb")
    shown = int((octagon_radii(scene.opacities) > 0).sum())
    for name in ("a.glb", "a.viewer.glb"):
        assert len(read_scene(tmp_path / name)[0]) == shown


def test_octagon_glb_too_large_is_refused_before_writing(
    make_scene: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_scene(100)
    export_scene(scene, tmp_path / "a.glb")
    size = (tmp_path / "a.glb").stat().st_size
    monkeypatch.setattr(glb_container, "MAX_BYTES", size)
    export_scene(scene, tmp_path / "b.glb")
    monkeypatch.setattr(glb_container, "MAX_BYTES", size - 1)
    with pytest.raises(SceneFileError, match=r"c\.glb: not written; .*min_opacity.*mesh PLY"):
        export_scene(scene, tmp_path / "c.glb")
    assert not (tmp_path / "c.glb").exists()


def test_large_scene_is_split_into_files(
    make_scene: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = make_scene(5000)
    export_scene(scene, tmp_path / "whole.glb")
    whole = Glb(tmp_path / "whole.glb")
    limit = int(0.45 * (tmp_path / "whole.glb").stat().st_size)
    monkeypatch.setattr(glb_container, "MAX_BYTES", limit)
    written = export_scene(scene, tmp_path / "a.glb")
    assert [path.name for path in written] == ["a.glb", "a.part2.glb", "a.part3.glb"]
    assert all(path.stat().st_size <= limit for path in written)
    parts = [Glb(path) for path in written]
    assert [part.json["asset"]["extras"]["octasplat_part"] for part in parts] == [[1, 3], [2, 3], [3, 3]]
    assert all(part.json["asset"]["extras"]["octasplat_gaussians"] == 5000 for part in parts)
    assert "octasplat_part" not in whole.json["asset"]["extras"]
    back, report = read_scene(written[1])
    assert len(back) < 5000
    assert any("It is part 2 of the 3 files" in note for note in report.notes)
    assert not any("fainter" in note for note in report.notes)
    with pytest.raises(SceneFileError, match="is part 2 of the 3 files of its scene"):
        recover_gaussians(scene, read_mesh(written[1]), written[1])
    together = [arrays for part in parts for arrays in part.primitives()]
    for ours, expected in zip(together, whole.primitives(), strict=True):
        for name in expected:
            np.testing.assert_array_equal(ours[name], expected[name])


@pytest.mark.parametrize(("chunks", "expected"), [(1, 1), (4, 4), (7, 4), (4096, 8)])
def test_octagon_glb_chunk_count_option_is_used(
    make_scene: Make, tmp_path: Path, chunks: int, expected: int
) -> None:
    export_scene(make_scene(3000), tmp_path / "a.glb", ExportOptions(chunks=chunks))
    assert len(Glb(tmp_path / "a.glb").primitives()) == expected


def test_octagon_glb_opaque_keeps_octagons_above_cutoff(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(2000)
    export_scene(scene, tmp_path / "a.glb", ExportOptions(opaque=True, chunks=1))
    glb = Glb(tmp_path / "a.glb")
    (material,) = glb.json["materials"]
    assert material["alphaMode"] == "MASK" and material["alphaCutoff"] == OPAQUE_CUTOFF
    (arrays,) = glb.primitives()
    ids = arrays["_GID"][::8].astype(int)
    np.testing.assert_array_equal(ids, np.flatnonzero(scene.opacities > OPAQUE_CUTOFF))
    # Half way along an edge an octagon is narrowest; alpha must have fallen to the cut there, but not far.
    middles = 0.5 * (
        arrays["TEXCOORD_0"] + np.roll(arrays["TEXCOORD_0"].reshape(-1, 8, 2), 1, 1).reshape(-1, 2)
    )
    rho2 = ExportOptions().q * np.sum((2 * middles.astype(np.float64) - 1) ** 2, axis=1)
    alpha = arrays["COLOR_0"][:, 3] * np.exp(-rho2 / 2)
    np.testing.assert_allclose(alpha, OPAQUE_CUTOFF, rtol=1e-4)


def test_channels_are_attributes_of_every_corner(make_scene: Make, tmp_path: Path) -> None:
    scene = make_scene(1200)
    random = np.random.default_rng(0)
    albedo, spectrum = random.random((1200, 3), np.float32), random.random((1200, 5), np.float32)
    scene = scene.with_channels({"albedo": albedo, "spectrum": spectrum})
    export_scene(scene, tmp_path / "a.glb", ExportOptions(chunks=2))
    glb = Glb(tmp_path / "a.glb")
    assert glb.json["asset"]["extras"]["octasplat_channels"] == {"albedo": 3, "spectrum": 5}
    assert len(glb.primitives()) == 2
    for primitive in glb.primitives():
        ids = primitive["_GID"].astype(np.int64)
        for name, values in (("_ALBEDO", albedo), ("_SPECTRUM", spectrum)):
            for place in range(values.shape[1]):
                np.testing.assert_array_equal(primitive[f"{name}_{place}"], values[ids, place])
    back, _ = read_scene(tmp_path / "a.glb")
    shown = octagon_radii(scene.opacities) > 0
    assert back.channels.widths == scene.channels.widths
    for name, values in scene.channels.items():
        np.testing.assert_array_equal(back.channels[name], values[shown])


def test_lit_octagons_have_their_own_materials(make_scene: Make, tmp_path: Path) -> None:
    count = 300
    random = np.random.default_rng(1)
    channels = {name: random.random((count, k), np.float32) for name, k in MATERIAL_WIDTHS.items()}
    scene = make_scene(count).with_channels(channels)
    export_scene(scene, tmp_path / "a.glb", ExportOptions(chunks=1, light_up=(0.0, 0.0, 1.0)))
    glb = Glb(tmp_path / "a.glb")
    (arrays,) = glb.primitives()
    ids = np.flatnonzero(octagon_radii(scene.opacities) > 0)
    (each,) = kd_split(scene.means_world[ids], 1)
    of = np.repeat(ids[each], 8)
    np.testing.assert_array_equal(arrays["COLOR_0"][:, :3], channels["albedo"][of])
    # As a viewer looks it up: between the pixels' middles of an image of all pairs.
    (material,) = glb.json["materials"]
    look_up = material["pbrMetallicRoughness"]["metallicRoughnessTexture"]
    assert look_up["texCoord"] == 1
    (tmp_path / "ramp.png").write_bytes(glb.view(glb.json["images"][look_up["index"]]["bufferView"]))
    ramp = oiio.ImageBuf(str(tmp_path / "ramp.png")).get_pixels(oiio.UINT8)
    at = arrays["TEXCOORD_1"] * 256 - 0.5
    low = np.minimum(at.astype(int), 254)
    share = at - low
    metallic, roughness = (
        (1 - s) * ramp[low[:, 1], low[:, 0], band] + s * ramp[low[:, 1] + 1, low[:, 0] + 1, band]
        for s, band in ((share[:, 0], 2), (share[:, 1], 1))
    )
    np.testing.assert_allclose(metallic / 255, channels["metallic"][of, 0], atol=1e-4)
    np.testing.assert_allclose(roughness / 255, channels["roughness"][of, 0], atol=1e-4)
    # Normals point to where the corners run anticlockwise.
    normals = rotation_matrices(scene.quats_wxyz)[of][:, :, 0]
    np.testing.assert_allclose(arrays["NORMAL"], normals, atol=1e-6)
    corners = arrays["POSITION"].reshape(-1, 8, 3).astype(np.float64)
    wound = np.cross(corners[:, 2] - corners[:, 0], corners[:, 4] - corners[:, 0])
    assert ((wound * normals[::8]).sum(axis=1) > 0).all()
    assert "extensions" not in material and "_GID" not in arrays
    # The light's up, z, becomes y.
    x, y, z, w = glb.json["nodes"][0]["rotation"]
    turn = rotation_matrices(np.array([[w, x, y, z]]))[0]
    np.testing.assert_allclose(turn @ [0, 0, 1], [0, 1, 0], atol=1e-12)


def test_octagons_without_materials_cannot_be_lit(make_scene: Make, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="has no materials"):
        export_scene(make_scene(5), tmp_path / "a.glb", ExportOptions(light_up=(0.0, 0.0, 1.0)))
    assert list(tmp_path.iterdir()) == []
