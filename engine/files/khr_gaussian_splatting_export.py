"""Export as binary glTF with ``KHR_gaussian_splatting``: points with the attributes of splats.

The extension knows one kernel, an ellipsoid; a flat Gaussian is one with a standard deviation of 1e-5 along
its first axis. The scene is turned to glTF's frame (y up) in the data, not by a node, so that readers that
evaluate harmonics in world directions are right too; the turn changes signs only and loses nothing.
"""

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engine.colour import srgb_to_linear
from engine.errors import SceneFileError
from engine.files.encodings import (
    HALF_TURN_SIGNS,
    bytes_from,
    half_turn_points,
    half_turn_quats,
    unit_quats,
)
from engine.files.options import ExportOptions
from engine.files.registry import Exporter, register
from engine.files.selection import blocks, check_scales, selected
from engine.gaussians.model import FLAT_SCALE, FlatGaussians
from engine.writing import replacing

EXTENSION = "KHR_gaussian_splatting"
ARRAY_BUFFER, UNSIGNED_BYTE, FLOAT, POINTS = 34962, 5121, 5126, 0
MAX_BYTES = 2**32 - 1
"""A GLB states its length in 32 bits."""
COLOUR_SPACE = "srgb_rec709_display"


@dataclass(frozen=True)
class _Attribute:
    """A vertex attribute: its semantic, type, and its rows, in glTF's frame, of a block in ours."""

    semantic: str
    kind: str
    component: int
    item_bytes: int
    rows: Callable[[FlatGaussians], np.ndarray]


def _colours(some: FlatGaussians) -> np.ndarray:
    """The fallback of readers that see points only: linear RGB of the constant harmonic, and opacity."""
    linear = srgb_to_linear(np.clip(some.base_rgb_srgb, 0.0, 1.0))
    return bytes_from(np.concatenate([linear, some.opacities[:, None]], axis=1).astype(np.float64) * 255.0)


def _scales(some: FlatGaussians) -> np.ndarray:
    flat = np.full((len(some), 1), FLAT_SCALE, dtype=np.float32)
    return np.concatenate([flat, some.scales], axis=1)


def _coefficient(number: int) -> Callable[[FlatGaussians], np.ndarray]:
    return lambda some: some.sh[:, number] * HALF_TURN_SIGNS[number]


def attributes(sh_degree: int) -> tuple[_Attribute, ...]:
    """All attributes of a scene with harmonics of that degree, in file order."""
    basic = (
        _Attribute("POSITION", "VEC3", FLOAT, 12, lambda some: half_turn_points(some.means_world)),
        _Attribute("COLOR_0", "VEC4", UNSIGNED_BYTE, 4, _colours),
        _Attribute(
            f"{EXTENSION}:ROTATION",
            "VEC4",
            FLOAT,
            16,
            lambda some: unit_quats(half_turn_quats(some.quats_wxyz)[:, [1, 2, 3, 0]]),
        ),
        _Attribute(f"{EXTENSION}:SCALE", "VEC3", FLOAT, 12, _scales),
        _Attribute(f"{EXTENSION}:OPACITY", "SCALAR", FLOAT, 4, lambda some: some.opacities),
    )
    harmonics = tuple(
        _Attribute(
            f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{place}", "VEC3", FLOAT, 12, _coefficient(degree**2 + place)
        )
        for degree in range(sh_degree + 1)
        for place in range(2 * degree + 1)
    )
    return basic + harmonics


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the Gaussians in their order, block by block.

    Raises:
        SceneFileError: nothing to write, values that are not finite, more than the 4 GiB that a GLB can hold,
            or the file cannot be written.
    """
    scene = selected(gaussians, path, options)
    check_scales(scene, path)
    layout = attributes(scene.sh_degree)
    document = _document(scene, layout)
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text = text.ljust(-(-len(text) // 4) * 4)
    length = len(scene) * sum(attribute.item_bytes for attribute in layout)
    total = 12 + 8 + len(text) + 8 + length
    if total > MAX_BYTES:
        raise SceneFileError(
            f"{path}: not written; {len(scene)} Gaussians need {total / 2**30:.1f} GiB, and a GLB holds at "
            "most 4. Leave faint ones out with min_opacity, or export a Gaussian PLY."
        )
    try:
        with replacing(path) as temporary, temporary.open("wb") as handle:
            handle.write(struct.pack("<4sIII4s", b"glTF", 2, total, len(text), b"JSON") + text)
            handle.write(struct.pack("<I4s", length, b"BIN\0"))
            for attribute in layout:
                for block in blocks(scene):
                    values = attribute.rows(block)
                    kind = "u1" if attribute.component == UNSIGNED_BYTE else "<f4"
                    handle.write(np.ascontiguousarray(values.astype(kind, copy=False)).data)
            assert handle.tell() == total
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be written ({error.strerror or error}).") from error
    return (path,)


def _document(scene: FlatGaussians, layout: tuple[_Attribute, ...]) -> dict[str, object]:
    low, high = scene.means_world.min(axis=0), scene.means_world.max(axis=0)
    views: list[dict[str, object]] = []
    accessors: list[dict[str, object]] = []
    offset = 0
    for number, attribute in enumerate(layout):
        length = len(scene) * attribute.item_bytes
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": length, "target": ARRAY_BUFFER})
        offset += length
        accessor: dict[str, object] = {
            "bufferView": number,
            "componentType": attribute.component,
            "count": len(scene),
            "type": attribute.kind,
        }
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
        "mode": POINTS,
        "extensions": {
            EXTENSION: {
                "kernel": "ellipse",
                "colorSpace": COLOUR_SPACE,
                "projection": "perspective",
                "sortingMethod": "cameraDistance",
            }
        },
    }
    return {
        "asset": {"version": "2.0", "generator": "octasplat"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "octasplat", "mesh": 0}],
        "meshes": [{"name": "gaussians", "primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }


register(
    Exporter(
        "khr-glb",
        ("*.splats.glb", "*_splats.glb", "*-splats.glb", "splats.glb"),
        "Gaussians as glTF points with KHR_gaussian_splatting",
        write,
    )
)
