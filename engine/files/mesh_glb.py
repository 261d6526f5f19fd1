"""Meshes from GLB: all triangles of the default scene, with node transforms applied and ids kept.

Only what meshes need of glTF is read, straight into arrays: the general libraries either drop vertex
attributes that they do not know or stop at the raw bytes.
"""

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from engine.errors import SceneFileError
from engine.files.mesh import Mesh

COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
TRIANGLES = 4
COMPRESSIONS = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
MAX_DEPTH = 256
ATTRIBUTES = {"gid": "_GID", "corner": "_CORNER", "radius": "_RADIUS"}


def read_glb(path: Path) -> Mesh:
    """Read the triangles of a GLB, in the frame of its scene, in which glTF says that y is up.

    Raises:
        SceneFileError: the file is no GLB, is damaged, or its meshes are compressed.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be read ({error.strerror or error}).") from error
    document, binary = _parts_of_file(path, content)
    packed = [name for name in COMPRESSIONS if name in document.get("extensionsUsed", [])]
    if packed:
        raise SceneFileError(
            f"{path}: its meshes are compressed ({packed[0]}), which changes the order of vertices; "
            "export it without compression."
        )
    try:
        return _Reader(document, binary).mesh()
    except (KeyError, IndexError, TypeError, ValueError, AttributeError) as error:
        raise SceneFileError(f"{path}: its glTF is damaged or not understood ({error}).") from error


def _parts_of_file(path: Path, content: bytes) -> tuple[dict[str, Any], memoryview]:
    if content[:4] != b"glTF" or len(content) < 20:
        raise SceneFileError(f"{path}: is no GLB file.")
    document: dict[str, Any] | None = None
    binary = memoryview(b"")
    offset = 12
    while offset + 8 <= len(content):
        length, kind = struct.unpack_from("<I4s", content, offset)
        data = memoryview(content)[offset + 8 : offset + 8 + length]
        if len(data) < length:
            raise SceneFileError(f"{path}: is truncated.")
        if kind == b"JSON":
            try:
                document = json.loads(bytes(data))
            except ValueError as error:
                raise SceneFileError(f"{path}: its JSON part is damaged.") from error
        elif kind == b"BIN\0" and not len(binary):
            binary = data
        offset += 8 + length
    if not isinstance(document, dict):
        raise SceneFileError(f"{path}: has no JSON part.")
    return document, binary


class _Reader:
    def __init__(self, document: dict[str, Any], binary: memoryview) -> None:
        self._document = document
        self._binary = binary

    def mesh(self) -> Mesh:
        vertices: list[np.ndarray] = []
        triangles: list[np.ndarray] = []
        extras: dict[str, list[np.ndarray]] = {"uv": [], "gid": [], "corner": [], "radius": []}
        count = 0
        for matrix, primitive in self._primitives():
            attributes = primitive["attributes"]
            positions = self._accessor(attributes["POSITION"]).astype(np.float64)
            size = len(positions)
            vertices.append(positions @ matrix[:3, :3].T + matrix[:3, 3])
            if "indices" in primitive:
                indices = self._accessor(primitive["indices"]).astype(np.int64).reshape(-1, 3)
            else:
                indices = np.arange(size - size % 3).reshape(-1, 3)
            triangles.append(indices + count)
            names = {"uv": "TEXCOORD_0", **ATTRIBUTES}
            for key, name in names.items():
                width = 2 if key == "uv" else 1
                if name in attributes:
                    extras[key].append(self._accessor(attributes[name]).astype(np.float32))
                else:
                    extras[key].append(np.full((size, width), np.nan, np.float32))
            count += size
        whole = {key: _joined(parts) for key, parts in extras.items()}
        q = self._document.get("asset", {}).get("extras", {}).get("octasplat_q")
        return Mesh(
            np.concatenate([*vertices, np.zeros((0, 3))]),
            np.concatenate([*triangles, np.zeros((0, 3), np.int64)]),
            uv=whole["uv"],
            gid=_flat(whole["gid"]),
            corner=_flat(whole["corner"]),
            radius=_flat(whole["radius"]),
            q=float(q) if isinstance(q, int | float) else None,
        )

    def _primitives(self) -> Iterator[tuple[Float64[np.ndarray, "4 4"], dict[str, Any]]]:
        """Every triangle primitive of the default scene with the matrix of its node."""
        nodes = self._document.get("nodes", [])
        scenes = self._document.get("scenes", [])
        roots = scenes[self._document.get("scene", 0)].get("nodes", []) if scenes else range(len(nodes))
        waiting = [(node, np.eye(4), 0) for node in reversed(list(roots))]
        while waiting:
            number, parent, depth = waiting.pop()
            if depth > MAX_DEPTH:
                raise ValueError("its nodes form a circle")
            node = nodes[number]
            matrix = parent @ _node_matrix(node)
            if "mesh" in node:
                for primitive in self._document["meshes"][node["mesh"]]["primitives"]:
                    if primitive.get("mode", TRIANGLES) == TRIANGLES:
                        yield matrix, primitive
            waiting += [(child, matrix, depth + 1) for child in reversed(node.get("children", []))]

    def _accessor(self, number: int) -> np.ndarray:
        accessor = self._document["accessors"][number]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError("sparse accessors are not read")
        view = self._document["bufferViews"][accessor["bufferView"]]
        if view.get("buffer", 0) != 0 or "uri" in self._document["buffers"][0]:
            raise ValueError("its data lies in another file")
        kind = np.dtype(COMPONENTS[accessor["componentType"]])
        width, count = WIDTHS[accessor["type"]], int(accessor["count"])
        offset = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride = view.get("byteStride", kind.itemsize * width)
        values = np.ndarray((count, width), kind, self._binary, offset, (stride, kind.itemsize))
        if accessor.get("normalized") and kind.kind in "iu":
            return np.maximum(values.astype(np.float64) / np.iinfo(kind).max, -1.0)
        return values


def _joined(parts: list[np.ndarray]) -> np.ndarray | None:
    """One array, or None where no part had the attribute."""
    if not parts:
        return None
    whole = np.concatenate(parts)
    return None if np.isnan(whole).all() else whole


def _flat(values: np.ndarray | None) -> np.ndarray | None:
    return None if values is None else values[:, 0]


def _node_matrix(node: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = node.get("rotation", (0, 0, 0, 1))
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix[:3, :3] = rotation * np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix
