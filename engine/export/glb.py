"""Export as binary glTF 2.0: the format to look at, as it carries colour, opacity and the Gaussian fall-off.

Base colour = white texture with radial alpha x COLOR_0, so that alpha = opacity * exp(-rho^2 / 2) at every
pixel (to the 8 bits of the texture). COLOR_0 is float32, as some programs misread 16-bit colours and 8-bit
linear colours are too coarse in the dark. Vertices stay in the world frame of COLMAP (y down, z forward); a
half turn about x in the root node brings them to glTF's (y up). The scene is cut into spatial chunks, each
with its own node, because viewers sort transparent objects, not triangles.
"""

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int

from engine.colour import srgb_to_linear
from engine.errors import SceneFileError
from engine.export.octagon_soup import OctagonBatch, OctagonSoup
from engine.export.options import ExportOptions
from engine.export.radial_alpha import white_with_alpha_png
from engine.export.registry import Exporter, register
from engine.export.spatial import kd_chunks
from engine.files import replacing
from engine.gaussians.model import FlatGaussians
from engine.gaussians.octagon import FAN, SIDES, octagon_triangles

MAX_CHUNKS = 64
MAX_BYTES = 2**32 - 1
"""A GLB states its length in 32 bits."""
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
FLOAT, UNSIGNED_INT = 5126, 5125
LINEAR, CLAMP_TO_EDGE = 9729, 33071
WIDEST_NUMBER = float(np.float32(-1.1754943508222875e-38))
HALF_TURN_ABOUT_X = [1.0, 0.0, 0.0, 0.0]
"""glTF writes quaternions x, y, z, w."""


@dataclass(frozen=True)
class Attribute:
    """A vertex attribute of glTF: its semantic and how many floats it has."""

    semantic: str
    width: int

    @property
    def type(self) -> str:
        """The shape, as glTF names it."""
        return "SCALAR" if self.width == 1 else f"VEC{self.width}"


OWN_ATTRIBUTES = (Attribute("POSITION", 3), Attribute("COLOR_0", 4), Attribute("TEXCOORD_0", 2))
GID = Attribute("_GID", 1)
CORNER = Attribute("_CORNER", 1)
Bounds = tuple[list[float], list[float]]


class _Layout:
    """Where all lies in the binary part: texture, indices and corner numbers (shared), then the chunks."""

    def __init__(self, chunk_sizes: list[int], png: bytes, options: ExportOptions, scene_size: int) -> None:
        self.chunk_sizes = chunk_sizes
        self.options = options
        self.scene_size = scene_size
        self.largest = max(chunk_sizes)
        self.attributes = (*OWN_ATTRIBUTES, *((GID,) if options.ids else ()))
        self.views: list[dict[str, object]] = []
        self.length = 0
        self._add_view(len(png))
        self._add_view(self.largest * len(FAN) * 3 * 4, target=ELEMENT_ARRAY_BUFFER)
        if options.ids:
            self._add_view(self.largest * SIDES * 4, target=ARRAY_BUFFER, byteStride=4)
        self.shared_views = len(self.views)
        for size in chunk_sizes:
            for attribute in self.attributes:
                self._add_view(size * SIDES * attribute.width * 4, target=ARRAY_BUFFER)

    def _add_view(self, length: int, **keys: int) -> None:
        self.views.append({"buffer": 0, "byteOffset": self.length, "byteLength": length, **keys})
        self.length += _padded(length)

    def document(self, bounds: list[Bounds]) -> dict[str, object]:
        """The JSON part, given each chunk's smallest and largest coordinates."""
        accessors: list[dict[str, object]] = []
        meshes: list[dict[str, object]] = []
        for chunk, size in enumerate(self.chunk_sizes):
            used: dict[str, int] = {}
            first_view = self.shared_views + chunk * len(self.attributes)
            for place, attribute in enumerate(self.attributes):
                used[attribute.semantic] = len(accessors)
                accessors.append(_accessor(first_view + place, FLOAT, size * SIDES, attribute.type))
            accessors[used["POSITION"]] |= {"min": bounds[chunk][0], "max": bounds[chunk][1]}
            if self.options.ids:
                used[CORNER.semantic] = len(accessors)
                accessors.append(_accessor(2, FLOAT, size * SIDES, CORNER.type))
            accessors.append(_accessor(1, UNSIGNED_INT, size * len(FAN) * 3, "SCALAR"))
            meshes.append(
                {"primitives": [{"attributes": used, "indices": len(accessors) - 1, "material": 0}]}
            )
        chunks = range(len(self.chunk_sizes))
        nodes: list[dict[str, object]] = [
            {"name": "octasplat", "rotation": HALF_TURN_ABOUT_X, "children": [1 + chunk for chunk in chunks]},
            *({"name": f"octagons_{chunk:02d}", "mesh": chunk} for chunk in chunks),
        ]
        return {
            "asset": {"version": "2.0", "generator": "octasplat", "extras": self._extras()},
            "extensionsUsed": ["KHR_materials_unlit"],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": nodes,
            "meshes": meshes,
            "materials": [MATERIAL],
            "textures": [{"sampler": 0, "source": 0}],
            "samplers": [
                {"magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}
            ],
            "images": [{"name": "radial_alpha", "mimeType": "image/png", "bufferView": 0}],
            "accessors": accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": self.length}],
        }

    def _extras(self) -> dict[str, object]:
        return {"octasplat_q": self.options.q, "octasplat_gaussians": self.scene_size}


MATERIAL: dict[str, object] = {
    "name": "octagons",
    "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicFactor": 0.0, "roughnessFactor": 1.0},
    "extensions": {"KHR_materials_unlit": {}},
    "alphaMode": "BLEND",
    "doubleSided": True,
}


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the octagons as unlit, blended meshes; memory stays at one chunk's vertices.

    Raises:
        SceneFileError: nothing to write, or more than the 4 GiB that a GLB can hold.
    """
    soup = OctagonSoup(gaussians, path, options)
    chunks = kd_chunks(soup.means_world, MAX_CHUNKS)
    png = white_with_alpha_png(options.texture_size, options.q)
    layout = _Layout([len(chunk) for chunk in chunks], png, options, soup.scene_size)
    # The JSON comes first in the file but holds the bounds of all vertices, so room is kept for the longest.
    widest = ([WIDEST_NUMBER] * 3, [WIDEST_NUMBER] * 3)
    room = _padded(len(_encode(layout.document([widest] * len(chunks)))))
    total = 12 + 8 + room + 8 + layout.length
    if total > MAX_BYTES:
        raise SceneFileError(
            f"{path}: not written; {len(soup)} octagons need {total / 2**30:.1f} GiB, and a GLB holds "
            "at most 4. Leave faint Gaussians out with min_opacity, or export a mesh PLY."
        )
    try:
        with replacing(path) as temporary, temporary.open("wb") as handle:
            handle.write(struct.pack("<4sII", b"glTF", 2, total) + struct.pack("<I4s", room, b"JSON"))
            handle.seek(room, 1)
            handle.write(struct.pack("<I4s", layout.length, b"BIN\0"))
            bounds: list[Bounds] = []
            for data in _shared_data(layout, png):
                handle.write(data)
            for chunk in chunks:
                batch = soup.batch(chunk)
                for data in _chunk_data(batch, options.ids):
                    handle.write(data)
                corners = batch.corners_world.reshape(-1, 3)
                bounds.append((corners.min(axis=0).tolist(), corners.max(axis=0).tolist()))
            assert handle.tell() == total
            handle.seek(20)
            handle.write(_encode(layout.document(bounds)).ljust(room))
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be written ({error.strerror or error}).") from error
    return (path,)


def _shared_data(layout: _Layout, png: bytes) -> Iterator[bytes]:
    yield png.ljust(_padded(len(png)), b"\0")
    yield octagon_triangles(layout.largest).astype("<u4").tobytes()
    if layout.options.ids:
        yield np.tile(np.arange(SIDES, dtype="<f4"), layout.largest).tobytes()


def _chunk_data(batch: OctagonBatch, ids: bool) -> Iterator[bytes]:
    """The attributes of one chunk, in the order of the layout; all are multiples of four bytes."""
    yield batch.corners_world.astype("<f4").tobytes()
    rgba = np.concatenate([srgb_to_linear(batch.rgb_srgb), batch.opacities[:, None]], axis=1)
    yield _per_corner(rgba).tobytes()
    yield batch.uv.astype("<f4").tobytes()
    if ids:
        yield _per_corner(batch.ids[:, None]).tobytes()


def _per_corner(values: Float32[np.ndarray, "n c"] | Int[np.ndarray, "n c"]) -> Float32[np.ndarray, "m c"]:
    return np.repeat(values.astype("<f4"), SIDES, axis=0)


def _accessor(view: int, component: int, count: int, kind: str) -> dict[str, object]:
    return {"bufferView": view, "componentType": component, "count": count, "type": kind}


def _padded(length: int) -> int:
    return -(-length // 4) * 4


def _encode(document: dict[str, object]) -> bytes:
    return json.dumps(document, separators=(",", ":"), allow_nan=False).encode()


register(Exporter("glb", ("*.glb",), "octagon mesh as GLB with opacity and fall-off, for looking at", write))
