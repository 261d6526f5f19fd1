"""GLB with the Gaussians as SPZ, by ``KHR_gaussian_splatting_compression_spz_2``; :mod:`khr_glb` reads it.

The accessors say what comes out of the SPZ and have no data of their own. As the extension asks, colors and
opacities are in ``COLOR_0``, and there is no harmonic of degree 0.
"""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from octasplat.engine.files import glb_container
from octasplat.engine.files.encodings import half_turn_points
from octasplat.engine.files.glb_container import FLOAT, UNSIGNED_BYTE, pad_to_four, write_glb
from octasplat.engine.files.khr_glb import COMPRESSION, EXTENSION, splats_json
from octasplat.engine.files.spz import encode
from octasplat.engine.files.spz_container import write_spz
from octasplat.engine.gaussians.model import FlatGaussians

EXTENSIONS = (EXTENSION, COMPRESSION)
"""That a reader has to know."""
SPZ_VERSION = 3
"""The newest that the extension has."""


def write_compressed_glb(scene: FlatGaussians, path: Path, centre_world: Float64[np.ndarray, "3"]) -> None:
    """Write Gaussians in their order, turned to y up, without their channels.

    Args:
        scene: finite Gaussians, one at least.
        path: the file, replaced if it exists.
        centre_world: positions are stored about it, which leaves the 24 bits of SPZ for small steps.

    Raises:
        SceneFileError: positions are too far from the centre for SPZ.
        OSError: the file cannot be written.
    """
    means = (scene.means_world.astype(np.float64) - centre_world).astype(np.float32)
    about = replace(scene, means_world=means)
    packed = io.BytesIO()
    write_spz(encode(about, path, SPZ_VERSION), packed)
    data = packed.getvalue()
    text = glb_container.json_bytes(_gltf_json(about, centre_world, len(data)))
    length = pad_to_four(len(data))
    write_glb(path, pad_to_four(len(text)), length, [data.ljust(length, b"\0")], lambda: text)


def _gltf_json(
    scene: FlatGaussians, centre_world: Float64[np.ndarray, "3"], length: int
) -> dict[str, object]:
    kinds = {
        "POSITION": ("VEC3", FLOAT),
        "COLOR_0": ("VEC4", UNSIGNED_BYTE),
        f"{EXTENSION}:SCALE": ("VEC3", FLOAT),
        f"{EXTENSION}:ROTATION": ("VEC4", FLOAT),
        **{
            f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{place}": ("VEC3", FLOAT)
            for degree in range(1, scene.sh_degree + 1)
            for place in range(2 * degree + 1)
        },
    }
    accessors: list[dict[str, object]] = [
        {"componentType": component, "count": len(scene), "type": kind} for kind, component in kinds.values()
    ]
    turned = half_turn_points(scene.means_world)
    accessors[0] |= {"min": turned.min(axis=0).tolist(), "max": turned.max(axis=0).tolist()}
    accessors[1]["normalized"] = True
    primitive = {
        "attributes": {semantic: number for number, semantic in enumerate(kinds)},
        "mode": glb_container.POINTS,
        "extensions": {EXTENSION: {**splats_json(), "extensions": {COMPRESSION: {"bufferView": 0}}}},
    }
    x, y, z = centre_world.tolist()
    return {
        "asset": {"version": "2.0", "generator": "octasplat"},
        "extensionsUsed": list(EXTENSIONS),
        "extensionsRequired": list(EXTENSIONS),
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        # a matrix, as CesiumJS takes no translation of splats (1.145)
        "nodes": [{"matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, x, -y, -z, 1], "mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteLength": length}],
        "buffers": [{"byteLength": pad_to_four(length)}],
    }
