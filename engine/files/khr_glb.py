"""Binary glTF with ``KHR_gaussian_splatting``: points with the attributes of splats.

The extension knows one kernel, an ellipsoid; a flat Gaussian is one with a standard deviation of 1e-5 along
its first axis. glTF is y up; the scene is turned by 180 degrees about x in the data, not by a node, so that
readers that evaluate harmonics in world directions are right too. With untransformed nodes that changes signs
only, so that our own files keep the bits of positions and harmonics.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.core.color import linear_to_srgb, round_to_bytes, srgb_to_linear
from octasplat.engine.core.errors import ConfigError, SceneFileError
from octasplat.engine.files import glb_container
from octasplat.engine.files.channel_columns import ChannelChoice, select_channel_columns
from octasplat.engine.files.encodings import (
    HALF_TURN_SIGNS,
    MAX_SH_DEGREE,
    dropped_sh_message,
    half_turn_points,
    half_turn_quats,
    half_turn_sh,
    sh0_from_rgb,
    unit_quats,
)
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.glb_container import FLOAT, UNSIGNED_BYTE, GlbFile, pad_to_four, write_glb
from octasplat.engine.files.glb_place import root_place
from octasplat.engine.files.octagon_glb_reader import octagon_q, read_octagons
from octasplat.engine.files.registry import Exporter, Importer, register
from octasplat.engine.files.splat_rows import check_scales, iterate_blocks, select_for_export
from octasplat.engine.files.spz import decode
from octasplat.engine.files.spz_container import parse_spz
from octasplat.engine.gaussians.channels import Channels, merge_widths
from octasplat.engine.gaussians.flattening import GaussianCloud
from octasplat.engine.gaussians.frames import quaternions_from_matrices, rotation_matrices
from octasplat.engine.gaussians.model import FLAT_SCALE, SH_C0, FlatGaussians
from octasplat.engine.gaussians.rows import concatenate_rows
from octasplat.engine.gaussians.scene_metadata import SceneMetadata
from octasplat.engine.gaussians.spherical_harmonics import rotate_sh

EXTENSION = "KHR_gaussian_splatting"
COMPRESSION = "KHR_gaussian_splatting_compression_spz_2"
"""Within the former: all attributes are those of an SPZ, in the frame of the primitive."""
COLOR_SPACE = "srgb_rec709_display"
SIMILARITY_TOLERANCE = 1e-4
"""Relative error up to which a node may fail to be a rotation with one scale."""


def read(path: Path, channels: ChannelChoice = "own") -> GaussianCloud:
    """Read all splats of the default scene, node transforms applied, or else its octagons.

    Args:
        path: the file.
        channels: which of the attributes that begin with _ become channels, by their names in lower case.

    Raises:
        SceneFileError: the file is no GLB, is damaged, holds neither splats nor octagons of ours, compressed
            splats or edited octagons, scales them unevenly, or has no such channel.
    """
    file = GlbFile(path)
    clouds = []
    try:
        declared = glb_container.declared_channel_attributes(file.document)
        for matrix, primitive in file.primitives():
            splats = primitive.get("extensions", {}).get(EXTENSION)
            if splats is None:
                continue
            attributes = primitive["attributes"]
            cloud = _to_world(path, _read_cloud(path, file, attributes, splats), file.about_origin(matrix))
            columns = {name[1:].lower(): number for name, number in attributes.items() if name[0] == "_"}
            requested = select_channel_columns(path, declared, columns, channels)
            named = Channels({name: _read_channel(file, columns, own) for name, own in requested.items()})
            clouds.append(replace(cloud, channels=named))
        if not clouds:
            q = octagon_q(file)
            if q is not None:
                return read_octagons(file, path, q, channels)
            raise SceneFileError(
                f"{path}: holds no splats ({EXTENSION}); if it is an edited octagon mesh, use octasplat edit."
            )
        return _concatenate_clouds(clouds)
    except ConfigError as error:
        raise SceneFileError(f"{path}: {error}") from error
    except glb_container.GLB_READ_ERRORS as error:
        raise SceneFileError(f"{path}: its glTF is damaged or not understood ({error}).") from error


def _read_channel(
    file: GlbFile, attributes: Mapping[str, int], columns: tuple[str, ...]
) -> Float32[np.ndarray, "n f"]:
    return np.concatenate([file.array(attributes[column], np.float32) for column in columns], axis=1)


def _read_cloud(
    path: Path, file: GlbFile, attributes: dict[str, int], splats: dict[str, Any]
) -> GaussianCloud:
    """Return the Gaussians of a primitive, in its own frame."""
    further = splats.get("extensions", {})
    if unknown := ", ".join(name for name in further if name != COMPRESSION):
        raise SceneFileError(f"{path}: its splats need {unknown}, which is not read.")
    if further:
        return decode(path, parse_spz(path, file.view_bytes(further[COMPRESSION]["bufferView"])))
    xyzw = file.array(attributes[f"{EXTENSION}:ROTATION"], np.float32)
    sh = _read_harmonics(file, attributes)
    notes: tuple[str, ...] = ()
    if splats.get("colorSpace") == "lin_rec709_display":
        notes = ("Its colors are linear; they were converted, without what depends on the view.",)
        sh = sh0_from_rgb(linear_to_srgb(0.5 + SH_C0 * sh[:, 0]))
    # Opacities of 0 and 1 have infinite logits, which flatten() replaces.
    with np.errstate(divide="ignore", invalid="ignore"):
        opacity = file.array(attributes[f"{EXTENSION}:OPACITY"], np.float32)[:, 0].astype(np.float64)
        logits = np.log(opacity) - np.log1p(-opacity)
        log_scales = np.log(file.array(attributes[f"{EXTENSION}:SCALE"], np.float32))
    return GaussianCloud(
        means_world=file.array(attributes["POSITION"], np.float32),
        quats_wxyz=np.ascontiguousarray(xyzw[:, [3, 0, 1, 2]]),
        log_scales=log_scales,
        opacity_logits=logits.astype(np.float32),
        sh=sh,
        notes=(*notes, *dropped_sh_message(_sh_degree_of(attributes))),
    )


def _sh_degree_of(attributes: dict[str, int]) -> int:
    """Return the highest degree of which there are coefficients."""
    found = (re.fullmatch(rf"{EXTENSION}:SH_DEGREE_(\d+)_COEF_0", name) for name in attributes)
    return max((int(match[1]) for match in found if match), default=0)


def _read_harmonics(file: GlbFile, attributes: dict[str, int]) -> Float32[np.ndarray, "n k 3"]:
    bands: list[np.ndarray] = []
    for degree in range(MAX_SH_DEGREE + 1):
        names = [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{place}" for place in range(2 * degree + 1)]
        if not all(name in attributes for name in names):
            break
        bands.extend(file.array(attributes[name], np.float32) for name in names)
    if not bands:
        raise KeyError(f"{EXTENSION}:SH_DEGREE_0_COEF_0")
    return np.stack(bands, axis=1)


def _to_world(path: Path, cloud: GaussianCloud, matrix: Float64[np.ndarray, "4 4"]) -> GaussianCloud:
    """Return the cloud in the world frame: its node's transform, then the half turn to y down."""
    if not np.array_equal(matrix, np.eye(4)):
        cloud = _apply_node_transform(path, cloud, matrix)
    return replace(
        cloud,
        means_world=half_turn_points(cloud.means_world),
        quats_wxyz=half_turn_quats(cloud.quats_wxyz),
        sh=half_turn_sh(cloud.sh),
    )


def _apply_node_transform(
    path: Path, cloud: GaussianCloud, matrix: Float64[np.ndarray, "4 4"]
) -> GaussianCloud:
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    # A map that mirrors has a negative determinant.
    if not scale > 0 or np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() > SIMILARITY_TOLERANCE:
        raise SceneFileError(f"{path}: a node mirrors its splats or scales them unevenly; apply it first.")
    rotation = linear / scale
    frames = rotation @ rotation_matrices(cloud.quats_wxyz.astype(np.float64))
    turns = np.broadcast_to(rotation, (len(frames), 3, 3))
    means = cloud.means_world.astype(np.float64) @ linear.T + matrix[:3, 3]
    return replace(
        cloud,
        means_world=means.astype(np.float32),
        quats_wxyz=quaternions_from_matrices(frames).astype(np.float32),
        log_scales=(cloud.log_scales + np.log(scale)).astype(np.float32),
        min_log_scale=cloud.min_log_scale + float(np.log(scale)),
        sh=rotate_sh(cloud.sh, turns),
    )


def _concatenate_clouds(clouds: list[GaussianCloud]) -> GaussianCloud:
    if len(clouds) == 1:
        return clouds[0]
    most = max(cloud.sh.shape[1] for cloud in clouds)
    widths = merge_widths(cloud.channels for cloud in clouds)
    alike = [
        replace(
            cloud,
            sh=np.pad(cloud.sh, ((0, 0), (0, most - cloud.sh.shape[1]), (0, 0))),
            channels=cloud.channels.with_filled(widths, len(cloud.sh)),
        )
        for cloud in clouds
    ]
    notes = tuple(dict.fromkeys(note for cloud in clouds for note in cloud.notes))
    return replace(concatenate_rows(alike), notes=notes)


@dataclass(frozen=True)
class _Attribute:
    """A vertex attribute: its semantic, type, and its rows, in glTF's frame, of a block in ours."""

    semantic: str
    kind: str
    component: int
    item_bytes: int
    rows: Callable[[FlatGaussians], np.ndarray]


def _fallback_colors(some: FlatGaussians) -> np.ndarray:
    """Return the fallback of readers of points: linear RGB of the constant harmonic, and opacity."""
    linear = srgb_to_linear(np.clip(some.base_rgb_srgb, 0.0, 1.0))
    return round_to_bytes(
        np.concatenate([linear, some.opacities[:, None]], axis=1).astype(np.float64) * 255.0
    )


def _scales_3d(some: FlatGaussians) -> np.ndarray:
    flat = np.full((len(some), 1), FLAT_SCALE, dtype=np.float32)
    return np.concatenate([flat, some.scales], axis=1)


def _sh_coefficient_reader(number: int) -> Callable[[FlatGaussians], np.ndarray]:
    return lambda some: some.sh[:, number] * HALF_TURN_SIGNS[number]


def _float_count(attribute: glb_container.ChannelAttribute) -> Callable[[FlatGaussians], np.ndarray]:
    return lambda some: some.channels[attribute.channel][:, attribute.part]


def _file_attributes(sh_degree: int, widths: Mapping[str, int]) -> tuple[_Attribute, ...]:
    """Return the attributes of a scene with that degree of harmonics and these channels, in file order."""
    basic = (
        _Attribute("POSITION", "VEC3", FLOAT, 12, lambda some: half_turn_points(some.means_world)),
        _Attribute("COLOR_0", "VEC4", UNSIGNED_BYTE, 4, _fallback_colors),
        _Attribute(
            f"{EXTENSION}:ROTATION",
            "VEC4",
            FLOAT,
            16,
            lambda some: unit_quats(half_turn_quats(some.quats_wxyz)[:, [1, 2, 3, 0]]),
        ),
        _Attribute(f"{EXTENSION}:SCALE", "VEC3", FLOAT, 12, _scales_3d),
        _Attribute(f"{EXTENSION}:OPACITY", "SCALAR", FLOAT, 4, lambda some: some.opacities),
    )
    harmonics = tuple(
        _Attribute(
            f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{place}",
            "VEC3",
            FLOAT,
            12,
            _sh_coefficient_reader(degree**2 + place),
        )
        for degree in range(sh_degree + 1)
        for place in range(2 * degree + 1)
    )
    named = tuple(
        _Attribute(
            each.semantic, glb_container.vector_type(each.width), FLOAT, each.width * 4, _float_count(each)
        )
        for each in glb_container.channel_attributes(widths)
    )
    return basic + harmonics + named


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the Gaussians in their order, block by block.

    Raises:
        SceneFileError: nothing to write, values that are not finite, or more than the 4 GiB that a GLB can
            hold.
        OSError: the file cannot be written.
    """
    scene = select_for_export(gaussians, path, options)
    check_scales(scene, path)
    layout = _file_attributes(scene.sh_degree, scene.channels.widths)
    text = glb_container.json_bytes(_gltf_json(scene, layout, options.facts))
    room = pad_to_four(len(text))
    length = len(scene) * sum(attribute.item_bytes for attribute in layout)
    total = glb_container.glb_size(room, length)
    if total > glb_container.MAX_BYTES:
        advice = "Leave faint ones out with min_opacity, or export a Gaussian PLY."
        raise glb_container.too_large_error(path, f"{len(scene)} Gaussians need", total, advice)
    write_glb(path, room, length, _binary_blocks(scene, layout), lambda: text)
    return (path,)


def _binary_blocks(scene: FlatGaussians, layout: tuple[_Attribute, ...]) -> Iterator[bytes]:
    for attribute in layout:
        kind = "u1" if attribute.component == UNSIGNED_BYTE else "<f4"
        for block in iterate_blocks(scene):
            yield attribute.rows(block).astype(kind, copy=False).tobytes()


def _gltf_json(
    scene: FlatGaussians, layout: tuple[_Attribute, ...], facts: SceneMetadata
) -> dict[str, object]:
    low, high = scene.means_world.min(axis=0), scene.means_world.max(axis=0)
    views: list[dict[str, object]] = []
    accessors: list[dict[str, object]] = []
    offset = 0
    for number, attribute in enumerate(layout):
        length = len(scene) * attribute.item_bytes
        views.append(
            {"buffer": 0, "byteOffset": offset, "byteLength": length, "target": glb_container.ARRAY_BUFFER}
        )
        offset += length
        accessor = glb_container.accessor_json(number, attribute.component, len(scene), attribute.kind)
        if attribute.component == UNSIGNED_BYTE:
            accessor["normalized"] = True
        accessors.append(accessor)
    # The half turn about x swaps and negates the bounds of y and z.
    accessors[0] |= {
        "min": [float(low[0]), float(-high[1]), float(-high[2])],
        "max": [float(high[0]), float(-low[1]), float(-low[2])],
    }
    primitive = {
        "attributes": {attribute.semantic: number for number, attribute in enumerate(layout)},
        "mode": glb_container.POINTS,
        "extensions": {EXTENSION: splats_json()},
    }
    extras = glb_container.channel_extras(scene.channels.widths)
    return {
        "asset": {"version": "2.0", "generator": "octasplat"} | ({"extras": extras} if extras else {}),
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "octasplat", "mesh": 0, **root_place(facts.origin_world, facts.georeference)}],
        "meshes": [{"name": "gaussians", "primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }


def splats_json() -> dict[str, object]:
    """Return what a primitive says of its splats."""
    return {
        "kernel": "ellipse",
        "colorSpace": COLOR_SPACE,
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }


def _recognises(head: bytes) -> bool:
    return head.startswith(b"glTF")


register(Importer("khr-glb", ("*.glb",), "glTF points with KHR_gaussian_splatting", read, _recognises, read))
register(
    Exporter(
        "khr-glb",
        ("*.splats.glb", "*_splats.glb", "*-splats.glb", "splats.glb"),
        "Gaussians as glTF points with KHR_gaussian_splatting",
        write,
        holds_channels=True,
        holds_harmonics=True,
        holds_origin=True,
    )
)
