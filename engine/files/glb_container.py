"""The binary glTF container: its JSON, the arrays that it describes, and the meshes of its scene.

Only what meshes and splats need of glTF is read, straight into arrays: the general libraries either drop
vertex attributes that they do not know or stop at the raw bytes.
"""

import json
import struct
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy.typing import DTypeLike

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.local_origin import MAX_DISTANCE, NO_ORIGIN, Origin
from octasplat.engine.core.writing import atomic_replace
from octasplat.engine.files.glb_place import (
    HALF_TURN_ABOUT_X,
    ORIGIN_KEY,
    TURN_KEY,
    georeference_of_nodes,
    rotation_of,
)
from octasplat.engine.gaussians.channels import column_names
from octasplat.engine.gaussians.frames import quaternions_from_matrices, rotation_matrices
from octasplat.engine.gaussians.scene_metadata import SceneMetadata

MAX_BYTES = 2**32 - 1
"""A GLB states its length in 32 bits."""
HEADER_BYTES, CHUNK_HEADER_BYTES = 12, 8
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
UNSIGNED_BYTE, UNSIGNED_INT, FLOAT = 5121, 5125, 5126
POINTS, TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN = 0, 4, 5, 6
LINEAR, LINEAR_MIPMAP_LINEAR, CLAMP_TO_EDGE = 9729, 9987, 33071
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
CORE_NODE_NAME = "octasplat_cores"
"""Says in the extras of a primitive that it shows octagons a second time."""
MAX_CHUNKS = 64
"""The specification knows two; others are passed over."""
MAX_PRIMITIVES = 100_000
MAX_CHANNEL_COLUMNS = 10_000
CHANNELS = "octasplat_channels"
ALL_ROWS = slice(None)
GLB_READ_ERRORS = (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError)
"""What reading a document that says nonsense may raise."""


class GlbFile:
    """A GLB opened for reading; its data are mapped, not read.

    Attributes:
        document: the JSON part.
    """

    def __init__(self, path: Path) -> None:
        """Open the file.

        Raises:
            SceneFileError: it cannot be read, is no GLB, is truncated, or its JSON part is damaged.
        """
        try:
            size = path.stat().st_size
            # An empty file cannot be mapped.
            content = np.memmap(path, np.uint8, "r") if size else np.zeros(0, np.uint8)
        except OSError as error:
            raise SceneFileError(f"{path}: cannot be read ({error.strerror or error}).") from error
        if content[:4].tobytes() != b"glTF" or len(content) < HEADER_BYTES + CHUNK_HEADER_BYTES:
            raise SceneFileError(f"{path}: is no GLB file.")
        document: Any = None
        self._binary = content[:0]
        offset, chunks = HEADER_BYTES, 0
        while offset + CHUNK_HEADER_BYTES <= len(content):
            start, chunks = offset + CHUNK_HEADER_BYTES, chunks + 1
            if chunks > MAX_CHUNKS:
                raise SceneFileError(f"{path}: has more than {MAX_CHUNKS} chunks, so it is damaged.")
            length, kind = struct.unpack("<I4s", content[offset:start].tobytes())
            data = content[start : start + length]
            if len(data) < length:
                raise SceneFileError(f"{path}: is truncated.")
            if kind == b"JSON":
                try:
                    document = json.loads(data.tobytes())
                except (ValueError, RecursionError) as error:
                    raise SceneFileError(f"{path}: its JSON part is damaged.") from error
            elif kind == b"BIN\0" and not len(self._binary):
                self._binary = data
            offset = start + length
        if not isinstance(document, dict):
            raise SceneFileError(f"{path}: has no JSON part.")
        self.document: dict[str, Any] = document

    def array(self, number: int, dtype: DTypeLike, rows: slice = ALL_ROWS) -> np.ndarray:
        """Return rows of an accessor as ``dtype``, copied; normalised integers become numbers in [-1, 1].

        Raises:
            KeyError, IndexError, TypeError, ValueError: the document does not describe it, or it is stored in
                a way that is not read.
        """
        accessor = self.document["accessors"][number]
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError("sparse accessors are not read")
        view = self.document["bufferViews"][accessor["bufferView"]]
        if view.get("buffer", 0) != 0 or "uri" in self.document["buffers"][0]:
            raise ValueError("its data lies in another file")
        kind = np.dtype(COMPONENTS[accessor["componentType"]])
        width, count = WIDTHS[accessor["type"]], int(accessor["count"])
        offset = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride = view.get("byteStride", kind.itemsize * width)
        if stride < kind.itemsize * width:  # rows that overlap could be more than the file has bytes
            raise ValueError(f"accessor {number} has rows that overlap")
        # numpy refuses an array that reaches beyond the buffer.
        values: np.ndarray = np.ndarray((count, width), kind, self._binary, offset, (stride, kind.itemsize))
        values = values[rows]
        if accessor.get("normalized") and kind.kind in "iu":
            # As glTF has it: the least integer is -1, too.
            values = np.maximum(values.astype(np.float64) / np.iinfo(kind).max, -1.0)
        return values.astype(dtype)

    def count(self, number: int) -> int:
        """Return the number of rows of an accessor.

        Raises:
            KeyError, IndexError, TypeError, ValueError: the document does not describe it.
        """
        count = int(self.document["accessors"][number]["count"])
        if count < 0:
            raise ValueError(f"accessor {number} has {count} rows")
        return count

    def view_bytes(self, number: int) -> bytes:
        """Return the bytes of a buffer view.

        Raises:
            KeyError, IndexError, TypeError, ValueError: the document does not describe it, or it is cut.
        """
        view = self.document["bufferViews"][number]
        start, length = int(view.get("byteOffset", 0)), int(view["byteLength"])
        content = self._binary[start : start + length].tobytes()
        if len(content) < length or start < 0 or length <= 0:
            raise ValueError("a buffer view reaches beyond the data")
        return content

    def primitives(self) -> Iterator[tuple[Float64[np.ndarray, "4 4"], dict[str, Any]]]:
        """Return every primitive of the default scene with its node's matrix, except cores of octagons.

        Raises:
            KeyError, IndexError, TypeError, ValueError: the document says nonsense; a node that is reached
                twice among it, as graphs of few nodes would become scenes without end.
        """
        for matrix, primitives in self._meshes:
            for primitive in primitives:
                if not primitive.get("extras", {}).get(CORE_NODE_NAME):
                    yield matrix, primitive

    @cached_property
    def _meshes(self) -> list[tuple[Float64[np.ndarray, "4 4"], list[dict[str, Any]]]]:
        """The primitives of each node of the default scene that has a mesh, with the node's matrix."""
        nodes = self.document.get("nodes", [])
        scenes = self.document.get("scenes", [])
        if scenes:
            roots = scenes[self.document.get("scene", 0)].get("nodes", [])
        else:
            inner = {child for node in nodes for child in node.get("children", [])}
            roots = [number for number in range(len(nodes)) if number not in inner]
        # A stack, hence reversed: nodes come in the order of the document.
        waiting = [(node, self._about_half_turn(node)) for node in reversed(roots)]
        reached: set[int] = set()
        found, count = [], 0
        while waiting:
            number, parent = waiting.pop()
            if number in reached:
                raise ValueError(f"its nodes form a circle or share node {number}")
            reached.add(number)
            node = nodes[number]
            matrix = parent @ _node_matrix(node)
            if "mesh" in node:
                found.append((matrix, self.document["meshes"][node["mesh"]]["primitives"]))
                count += len(found[-1][1])
                if count > MAX_PRIMITIVES:
                    raise ValueError(f"it has more than {MAX_PRIMITIVES} primitives")
            waiting += [(child, matrix) for child in reversed(node.get("children", []))]
        return found

    def _about_half_turn(self, root: int) -> Float64[np.ndarray, "4 4"]:
        """Return what makes a root that our exporters turned upright one that is turned by half about x."""
        matrix = np.eye(4)
        turn = self.document["nodes"][root].get("extras", {}).get(TURN_KEY)
        if turn is not None:
            matrix[:3, :3] = rotation_of(HALF_TURN_ABOUT_X) @ rotation_of(turn).T
        return matrix

    @cached_property
    def local_origin(self) -> Origin:
        """The origin of large coordinates in our world frame, zeros where there is none.

        It is the translation of the first primitive's node, if our exporters say so, or if it is so large
        against the primitive that 32 bits could not hold the sum.

        Raises:
            KeyError, IndexError, TypeError, ValueError: the document says nonsense.
        """
        for matrix, primitive in self.primitives():
            x, y, z = matrix[:3, 3].tolist()
            origin = (x, -y, -z)  # from y up to y down
            bounds = self.document["accessors"][primitive["attributes"]["POSITION"]]
            reach = max(
                (abs(value) for value in (*bounds.get("min", ()), *bounds.get("max", ()))), default=0.0
            )
            scale = float(np.cbrt(abs(np.linalg.det(matrix[:3, :3]))))
            is_own = any(node.get("extras", {}).get(ORIGIN_KEY) for node in self.document["nodes"])
            is_large = 0 < MAX_DISTANCE * scale * reach < float(np.linalg.norm(matrix[:3, 3]))
            return origin if is_own or is_large else NO_ORIGIN
        return NO_ORIGIN

    def about_origin(self, matrix: Float64[np.ndarray, "4 4"]) -> Float64[np.ndarray, "4 4"]:
        """Return the matrix of a node about :attr:`local_origin`."""
        x, y, z = self.local_origin
        local = matrix.copy()
        local[:3, 3] -= (x, -y, -z)
        return local


def read_glb_metadata(path: Path) -> SceneMetadata:
    """Return the local origin and the georeference of the scene in a GLB.

    Raises:
        SceneFileError: the file is no GLB, or is damaged.
    """
    try:
        file = GlbFile(path)
        georeference = georeference_of_nodes(file.document.get("nodes", []))
        return SceneMetadata(origin_world=file.local_origin, georeference=georeference)
    except GLB_READ_ERRORS as error:
        raise SceneFileError(f"{path}: its glTF is damaged or not understood ({error}).") from error


def is_half_turned(path: Path) -> bool:
    """Return whether octasplat wrote the meshes of a GLB, and no other program since, y up by a half turn.

    What is lit is turned as its light asks.

    Raises:
        SceneFileError: the file is no GLB, or is damaged.
    """
    match GlbFile(path).document:
        case {"asset": {"generator": "octasplat"}, "nodes": [{"rotation": list() as rotation, **root}, *_]}:
            extras = root.get("extras")
            is_upright = isinstance(extras, Mapping) and TURN_KEY in extras
            return is_upright or rotation == HALF_TURN_ABOUT_X
    return False


def _node_matrix(node: dict[str, Any]) -> Float64[np.ndarray, "4 4"]:
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T  # glTF stores columns
    matrix = np.eye(4)
    if "rotation" in node:
        x, y, z, w = node["rotation"]
        if not (x or y or z or w):
            raise ValueError("the rotation of a node has no length")
        matrix[:3, :3] = rotation_matrices(np.array([[w, x, y, z]], np.float64))[0]
    # scales the columns: rotation times scale
    matrix[:3, :3] *= np.array(node.get("scale", (1, 1, 1)), np.float64)
    matrix[:3, 3] = node.get("translation", (0, 0, 0))
    return matrix


def light_rotation(light_frame: Float64[np.ndarray, "3 3"]) -> list[float]:
    """Return the rotation of a root node (x, y, z, w) for what is lit.

    It brings the light's up to y and its forward to x, which is how viewers and Blender lay environments.

    Args:
        light_frame: right, up and forward of the light, as rows in the world.
    """
    # Forward, up, right as rows: forward becomes x, and up becomes y.
    w, x, y, z = quaternions_from_matrices(light_frame[None, [2, 1, 0]])[0].tolist()
    return [x, y, z, w]


def pad_to_four(length: int) -> int:
    """Return ``length`` rounded up to a multiple of four bytes, GLB's alignment."""
    return -(-length // 4) * 4


def accessor_json(view: int, component: int, count: int, kind: str) -> dict[str, object]:
    """Return the description of an array: all of buffer view ``view``, ``count`` items of type ``kind``."""
    return {"bufferView": view, "componentType": component, "count": count, "type": kind}


def vector_type(width: int) -> str:
    """Return the glTF accessor type of vectors with 1 to 4 components.

    >>> vector_type(1), vector_type(3)
    ('SCALAR', 'VEC3')
    """
    return "SCALAR" if width == 1 else f"VEC{width}"


@dataclass(frozen=True)
class ChannelAttribute:
    """A vertex attribute that holds a channel or one number of it.

    Attributes:
        semantic: such as ``_ALBEDO``.
        channel: the channel's name.
        part: which of its numbers.
        width: how many these are, at most 4.
    """

    semantic: str
    channel: str
    part: slice
    width: int


def channel_attributes(widths: Mapping[str, int], widest: int = 4) -> tuple[ChannelAttribute, ...]:
    """Return the attributes that hold channels: a vector up to ``widest`` numbers, else one scalar a number.

    Meshes have scalars alone: Blender 5 opens none whose own attributes differ in width.
    """
    found: list[ChannelAttribute] = []
    for name, width in widths.items():
        if width <= widest:
            found.append(ChannelAttribute(f"_{name.upper()}", name, slice(0, width), width))
        else:
            found += [
                ChannelAttribute(f"_{column.upper()}", name, slice(place, place + 1), 1)
                for place, column in enumerate(column_names(name, width))
            ]
    return tuple(found)


def channel_extras(widths: Mapping[str, int]) -> dict[str, object]:
    """Return what the ``extras`` of a file say of its channels: their names and widths."""
    return {CHANNELS: dict(widths)} if widths else {}


def declared_channel_attributes(
    document: Mapping[str, Any], columns: Collection[str]
) -> dict[str, tuple[str, ...]]:
    """Return the channels that a file's ``extras`` name, with their attributes in lower case without _.

    Args:
        document: JSON of the file.
        columns: attributes of a primitive, likewise. A channel is one vector there, as of splats, or a scalar
            for each of its numbers, as of octagons.
    """
    found = asset_extras(document).get(CHANNELS, {})
    widths = {name: int(width) for name, width in found.items() if width > 0}
    if sum(widths.values()) > MAX_CHANNEL_COLUMNS:
        raise ValueError(f"its channels have more than {MAX_CHANNEL_COLUMNS} columns")
    return {
        name: (name.lower(),)
        if name.lower() in columns
        else tuple(column.lower() for column in column_names(name, width))
        for name, width in widths.items()
    }


def json_bytes(document: dict[str, object]) -> bytes:
    """Return a document as it stands in the file, without what fills it up to four bytes."""
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode()


def asset_extras(document: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what a file says of itself beyond the standard; nothing where that is of another kind."""
    match document:
        case {"asset": {"extras": Mapping() as extras}}:
            return extras
    return {}


def glb_size(json_room: int, length: int) -> int:
    """Return the size of a file with so many bytes of JSON and of data."""
    return HEADER_BYTES + 2 * CHUNK_HEADER_BYTES + json_room + length


def too_large_error(path: Path, subject: str, total: int, advice: str) -> SceneFileError:
    """Return the error for a file beyond ``MAX_BYTES``; ``subject`` says what needs it, verb included."""
    return SceneFileError(
        f"{path}: not written; {subject} {total / 2**30:.1f} GiB, and a GLB holds at most 4. {advice}"
    )


def write_glb(
    path: Path, json_room: int, length: int, data: Iterable[bytes], document: Callable[[], bytes]
) -> None:
    """Write a GLB, atomically and piece by piece.

    The JSON comes first in the file, but may depend on the data: it is asked for when they are written.

    Args:
        path: the file, replaced if it exists.
        json_room: bytes kept for the JSON, a multiple of four.
        length: bytes of all data together, a multiple of four.
        data: the binary part in pieces.
        document: the JSON part, no longer than its room.

    Raises:
        OSError: the file cannot be written.
    """
    with atomic_replace(path) as temporary, temporary.open("wb") as handle:
        handle.write(struct.pack("<4sII", b"glTF", 2, glb_size(json_room, length)))
        handle.write(struct.pack("<I4s", json_room, b"JSON"))
        json_start = handle.tell()
        handle.seek(json_room, 1)
        handle.write(struct.pack("<I4s", length, b"BIN\0"))
        for piece in data:
            handle.write(piece)
        assert handle.tell() == glb_size(json_room, length)
        handle.seek(json_start)
        text = document()
        assert len(text) <= json_room
        handle.write(text.ljust(json_room))  # filled up with spaces, as the format asks
