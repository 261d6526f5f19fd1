"""Binary glTF with ``KHR_gaussian_splatting``: all splats of the default scene, node transforms applied.

glTF is y up; the scene is turned by 180 degrees about x, to y down. With untransformed nodes that changes
signs only, so that our own files keep the bits of positions and harmonics.
"""

import json
import mmap
import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from engine.colour import linear_to_srgb
from engine.errors import SceneFileError
from engine.files.encodings import half_turn_points, half_turn_quats, half_turn_sh, sh0_from_rgb
from engine.files.importing import Importer, register
from engine.gaussians.flattening import GaussianCloud
from engine.gaussians.frames import quaternions, rotation_matrices
from engine.gaussians.harmonics import rotate_sh
from engine.gaussians.model import SH_C0

EXTENSION = "KHR_gaussian_splatting"
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
MAX_DEPTH = 256
SIMILARITY = 1e-4
"""Relative error up to which a node may fail to be a rotation with one scale."""


def read(path: Path) -> GaussianCloud:
    """Read all splats.

    Raises:
        SceneFileError: the file is no GLB, is damaged, holds no splats (an octagon mesh, say) or compressed
            ones, or scales them unevenly.
    """
    try:
        with path.open("rb") as handle, mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ) as content:
            return _read(path, content)
    except (OSError, struct.error) as error:
        raise SceneFileError(f"{path}: cannot be read ({error}).") from error
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise SceneFileError(f"{path}: its glTF is damaged or not understood ({error}).") from error


def _read(path: Path, content: mmap.mmap) -> GaussianCloud:
    if content[:4] != b"glTF":
        raise SceneFileError(f"{path}: is no GLB file.")
    length, kind = struct.unpack_from("<I4s", content, 12)
    if kind != b"JSON" or 20 + length > len(content):
        raise SceneFileError(f"{path}: is truncated.")
    document: dict[str, Any] = json.loads(content[20 : 20 + length])
    start = 28 + length
    reader = _Reader(document, content, start)
    if start <= len(content):
        size = struct.unpack_from("<I", content, 20 + length)[0]
        if start + size > len(content):
            raise SceneFileError(f"{path}: is truncated.")
    clouds = []
    for matrix, mesh in _placed_meshes(document):
        for primitive in document["meshes"][mesh]["primitives"]:
            splats = primitive.get("extensions", {}).get(EXTENSION)
            if splats is None:
                continue
            if splats.get("extensions"):
                names = ", ".join(splats["extensions"])
                raise SceneFileError(f"{path}: its splats need {names}, which is not read.")
            clouds.append(_placed(path, reader.cloud(primitive["attributes"], splats), matrix))
    if not clouds:
        raise SceneFileError(
            f"{path}: holds no splats ({EXTENSION}); if it is an edited octagon mesh, use octasplat edit."
        )
    return _joined(clouds)


class _Reader:
    """Accessors of a GLB as arrays."""

    def __init__(self, document: dict[str, Any], content: mmap.mmap, start: int) -> None:
        self._document = document
        self._content = content
        self._start = start

    def cloud(self, attributes: dict[str, int], splats: dict[str, Any]) -> GaussianCloud:
        """The Gaussians of a primitive, in its own frame."""
        xyzw = self._array(attributes[f"{EXTENSION}:ROTATION"])
        sh = self._harmonics(attributes)
        notes: tuple[str, ...] = ()
        if splats.get("colorSpace") == "lin_rec709_display":
            notes = ("Its colours are linear; they were converted, without what depends on the view.",)
            sh = sh0_from_rgb(linear_to_srgb(0.5 + SH_C0 * sh[:, 0]))
        with np.errstate(divide="ignore", invalid="ignore"):
            opacity = self._array(attributes[f"{EXTENSION}:OPACITY"])[:, 0].astype(np.float64)
            logits = np.log(opacity) - np.log1p(-opacity)
            log_scales = np.log(self._array(attributes[f"{EXTENSION}:SCALE"]))
        return GaussianCloud(
            means_world=self._array(attributes["POSITION"]),
            quats_wxyz=np.ascontiguousarray(xyzw[:, [3, 0, 1, 2]]),
            log_scales=log_scales,
            opacity_logits=logits.astype(np.float32),
            sh=sh,
            notes=notes,
        )

    def _harmonics(self, attributes: dict[str, int]) -> Float32[np.ndarray, "n k 3"]:
        bands: list[np.ndarray] = []
        for degree in range(4):
            names = [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{place}" for place in range(2 * degree + 1)]
            if not all(name in attributes for name in names):
                break
            bands.extend(self._array(attributes[name]) for name in names)
        if not bands:
            raise KeyError(f"{EXTENSION}:SH_DEGREE_0_COEF_0")
        return np.stack(bands, axis=1)

    def _array(self, number: int) -> Float32[np.ndarray, "n c"]:
        accessor = self._document["accessors"][number]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError("sparse accessors are not read")
        view = self._document["bufferViews"][accessor["bufferView"]]
        if view.get("buffer", 0) != 0 or "uri" in self._document["buffers"][0]:
            raise ValueError("data outside the file is not read")
        kind = np.dtype(COMPONENTS[accessor["componentType"]])
        width, count = WIDTHS[accessor["type"]], int(accessor["count"])
        offset = self._start + view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride = view.get("byteStride", width * kind.itemsize)
        rows: np.ndarray = np.ndarray((count, width), kind, self._content, offset, (stride, kind.itemsize))
        values = rows.astype(np.float32)
        if accessor.get("normalized"):
            largest = float(np.iinfo(kind).max)
            values = np.maximum(values / np.float32(largest), np.float32(-1.0))
        return values


def _placed_meshes(document: dict[str, Any]) -> Iterator[tuple[Float64[np.ndarray, "4 4"], int]]:
    """The meshes of the default scene, each with its transform to the scene."""
    nodes = document.get("nodes", [])
    scenes = document.get("scenes")
    roots = scenes[document.get("scene", 0)].get("nodes", []) if scenes else range(len(nodes))
    waiting = [(number, np.eye(4), 0) for number in reversed(roots)]
    while waiting:
        number, above, depth = waiting.pop()
        if depth > MAX_DEPTH:
            raise ValueError("its nodes are nested too deeply")
        matrix = above @ _local(nodes[number])
        if "mesh" in nodes[number]:
            yield matrix, nodes[number]["mesh"]
        waiting.extend((child, matrix, depth + 1) for child in reversed(nodes[number].get("children", [])))


def _local(node: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    if "rotation" in node:
        x, y, z, w = node["rotation"]
        matrix[:3, :3] = rotation_matrices(np.array([[w, x, y, z]], dtype=np.float64))[0]
    matrix[:3, :3] *= np.array(node.get("scale", (1.0, 1.0, 1.0)))
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _placed(path: Path, cloud: GaussianCloud, matrix: Float64[np.ndarray, "4 4"]) -> GaussianCloud:
    """The cloud in the world frame: its node's transform, then the half turn to y down."""
    if not np.array_equal(matrix, np.eye(4)):
        cloud = _transformed(path, cloud, matrix)
    return replace(
        cloud,
        means_world=half_turn_points(cloud.means_world),
        quats_wxyz=half_turn_quats(cloud.quats_wxyz),
        sh=half_turn_sh(cloud.sh),
    )


def _transformed(path: Path, cloud: GaussianCloud, matrix: Float64[np.ndarray, "4 4"]) -> GaussianCloud:
    linear = matrix[:3, :3]
    scale = float(np.cbrt(np.linalg.det(linear)))
    if not scale > 0 or np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() > SIMILARITY:
        raise SceneFileError(f"{path}: a node mirrors its splats or scales them unevenly; apply it first.")
    rotation = linear / scale
    frames = rotation @ rotation_matrices(cloud.quats_wxyz.astype(np.float64))
    turns = np.broadcast_to(rotation, (len(frames), 3, 3))
    means = cloud.means_world.astype(np.float64) @ linear.T + matrix[:3, 3]
    return replace(
        cloud,
        means_world=means.astype(np.float32),
        quats_wxyz=quaternions(frames).astype(np.float32),
        log_scales=(cloud.log_scales + np.log(scale)).astype(np.float32),
        sh=rotate_sh(cloud.sh, turns),
    )


def _joined(clouds: list[GaussianCloud]) -> GaussianCloud:
    if len(clouds) == 1:
        return clouds[0]
    most = max(cloud.sh.shape[1] for cloud in clouds)
    padded = [np.pad(cloud.sh, ((0, 0), (0, most - cloud.sh.shape[1]), (0, 0))) for cloud in clouds]
    return GaussianCloud(
        means_world=np.concatenate([cloud.means_world for cloud in clouds]),
        quats_wxyz=np.concatenate([cloud.quats_wxyz for cloud in clouds]),
        log_scales=np.concatenate([cloud.log_scales for cloud in clouds]),
        opacity_logits=np.concatenate([cloud.opacity_logits for cloud in clouds]),
        sh=np.concatenate(padded),
        notes=tuple(dict.fromkeys(note for cloud in clouds for note in cloud.notes)),
    )


def _recognises(head: bytes) -> bool:
    return head.startswith(b"glTF")


register(Importer("khr-glb", ("*.glb",), "glTF points with KHR_gaussian_splatting", read, _recognises))
