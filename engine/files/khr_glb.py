"""Binary glTF with ``KHR_gaussian_splatting``: points with the attributes of splats.

The extension knows one kernel, an ellipsoid; a flat Gaussian is one with a standard deviation of 1e-5 along
its first axis. glTF is y up; the scene is turned by 180 degrees about x in the data, not by a node, so that
readers that evaluate harmonics in world directions are right too. With untransformed nodes that changes signs
only, so that our own files keep the bits of positions and harmonics.
"""

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octasplat.engine.core.color import round_to_bytes, srgb_to_linear
from octasplat.engine.files import glb_container, glb_parts
from octasplat.engine.files.encodings import (
    HALF_TURN_SIGNS,
    half_turn_points,
    half_turn_quats,
    unit_quats,
)
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.glb_container import FLOAT, UNSIGNED_BYTE, pad_to_four, write_glb
from octasplat.engine.files.glb_place import root_place
from octasplat.engine.files.range_losses import find_thickness_losses
from octasplat.engine.files.registry import Exporter, register
from octasplat.engine.files.splat_rows import check_scales, iterate_blocks, select_for_export
from octasplat.engine.gaussians.model import FLAT_SCALE, FlatGaussians
from octasplat.engine.gaussians.scene_metadata import SceneMetadata

EXTENSION = "KHR_gaussian_splatting"
COMPRESSION = "KHR_gaussian_splatting_compression_spz_2"
"""Within the former: all attributes are those of an SPZ, in the frame of the primitive."""
JSON_MARGIN = 1024
"""By so much at most the JSON of a part is longer than that of the whole, for bounds of more digits."""
COLOR_SPACE = "srgb_rec709_display"


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

    A scene for which one file is too small goes into ``path``, ``<stem>.part2.glb`` and so on.

    Raises:
        SceneFileError: nothing to write, or values that are not finite.
        OSError: a file cannot be written.
    """
    scene = select_for_export(gaussians, path, options)
    check_scales(scene, path)
    layout = _file_attributes(scene.sh_degree, scene.channels.widths)
    each = sum(attribute.item_bytes for attribute in layout)
    room = len(glb_container.json_bytes(_gltf_json(scene, layout, options.facts, (1, 1)))) + JSON_MARGIN
    most = max(1, (glb_container.MAX_BYTES - glb_container.glb_size(room, 0)) // each)
    count = -(-len(scene) // most)
    ends = [number * len(scene) // count for number in range(count + 1)]
    paths = glb_parts.part_paths(path, count)
    numbered = list(enumerate(itertools.pairwise(ends), start=1))
    for part_path, (number, rows) in glb_parts.in_order_of_writing(paths, numbered):
        part = scene.view(slice(*rows))
        text = glb_container.json_bytes(_gltf_json(part, layout, options.facts, (number, count)))
        data = _binary_blocks(part, layout)
        write_glb(part_path, pad_to_four(len(text)), len(part) * each, data, lambda: text)  # noqa: B023
    return paths


def _binary_blocks(scene: FlatGaussians, layout: tuple[_Attribute, ...]) -> Iterator[bytes]:
    for attribute in layout:
        kind = "u1" if attribute.component == UNSIGNED_BYTE else "<f4"
        for block in iterate_blocks(scene):
            yield attribute.rows(block).astype(kind, copy=False).tobytes()


def _gltf_json(
    scene: FlatGaussians, layout: tuple[_Attribute, ...], facts: SceneMetadata, part: tuple[int, int]
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
    extras = glb_container.channel_extras(scene.channels.widths) | glb_parts.part_extras(*part)
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


register(
    Exporter(
        "khr-glb",
        ("*.splats.glb", "*_splats.glb", "*-splats.glb", "splats.glb"),
        "Gaussians as glTF points with KHR_gaussian_splatting",
        write,
        holds_channels=True,
        holds_harmonics=True,
        holds_origin=True,
        find_losses=functools.partial(find_thickness_losses, "khr-glb"),
    )
)
