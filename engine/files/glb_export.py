"""Export as binary glTF 2.0: the format to look at, as it carries colour, opacity and the Gaussian fall-off.

Base colour = white texture with radial alpha x COLOR_0, so that alpha = opacity * exp(-rho^2 / 2) at every
pixel (to the 8 bits of the texture). COLOR_0 is float32, as some programs misread 16-bit colours and 8-bit
linear colours are too coarse in the dark. Vertices stay in the world frame of COLMAP (y down, z forward); a
half turn about x in the root node brings them to glTF's (y up). The scene is cut into spatial chunks, each
with its own node, because viewers sort transparent objects, not triangles.

The opaque variant needs no sorting: alpha is cut at a threshold (``alphaMode`` MASK), and each octagon
shrinks to the ellipse that is left of it.
"""

import itertools
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int

from engine.colour import srgb_to_linear
from engine.errors import SceneFileError
from engine.files.octagon_glb_layout import OPAQUE_CUTOFF, Bounds, GlbLayout, padded
from engine.files.octagon_soup import OctagonBatch, OctagonSoup
from engine.files.options import ExportOptions
from engine.files.registry import Exporter, register
from engine.files.spatial import kd_chunks
from engine.files.textures import white_with_alpha_png
from engine.gaussians.model import FlatGaussians
from engine.gaussians.octagon import SIDES, octagon_triangles
from engine.writing import replacing

MAX_BYTES = 2**32 - 1
"""A GLB states its length in 32 bits."""

Chunks = list[Int[np.ndarray, "_"]]


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write the octagons as unlit meshes; memory stays at one chunk's vertices.

    A scene for which one file is too small goes into ``path``, ``<stem>.part2.glb`` and so on, by chunks.

    Raises:
        SceneFileError: nothing to write, or a chunk that is larger than the 4 GiB that a GLB can hold.
    """
    soup = OctagonSoup(gaussians, path, options, OPAQUE_CUTOFF if options.opaque else None)
    png = white_with_alpha_png(options.texture_size, options.q)
    parts = _parts(soup, path, len(png), options)
    paths = [path, *(path.with_name(f"{path.stem}.part{k}{path.suffix}") for k in range(2, len(parts) + 1))]
    for part_path, (layout, chunks) in zip(paths, parts, strict=True):
        try:
            _write_file(part_path, layout, soup, chunks, png, options.ids)
        except OSError as error:
            raise SceneFileError(f"{part_path}: cannot be written ({error.strerror or error}).") from error
    return tuple(paths)


def _parts(
    soup: OctagonSoup, path: Path, png_size: int, options: ExportOptions
) -> list[tuple[GlbLayout, Chunks]]:
    """The fewest files that hold all chunks; neighbouring chunks stay together."""
    chunks = kd_chunks(soup.means_world, options.chunks)
    for count in range(1, len(chunks) + 1):
        bounds = np.linspace(0, len(chunks), count + 1).astype(int).tolist()
        groups = [chunks[start:end] for start, end in itertools.pairwise(bounds)]
        parts = [
            (GlbLayout([len(chunk) for chunk in group], png_size, options, extras), group)
            for group, extras in zip(groups, _extras(soup, options, count), strict=True)
        ]
        if all(layout.total <= MAX_BYTES for layout, _ in parts):
            return parts
    largest = max(layout.total for layout, _ in parts)
    raise SceneFileError(
        f"{path}: not written; its largest chunk needs {largest / 2**30:.1f} GiB, and a GLB holds at most 4. "
        "Allow more chunks, leave faint Gaussians out with min_opacity, or export a mesh PLY."
    )


def _extras(soup: OctagonSoup, options: ExportOptions, parts: int) -> list[dict[str, object]]:
    """What each file says of itself: enough for an edited mesh to find back to its Gaussians."""
    extras: dict[str, object] = {"octasplat_q": options.q, "octasplat_gaussians": soup.scene_size}
    if options.opaque:
        extras["octasplat_opaque_cutoff"] = OPAQUE_CUTOFF
    return [extras | ({"octasplat_part": [part, parts]} if parts > 1 else {}) for part in range(1, parts + 1)]


def _write_file(
    path: Path, layout: GlbLayout, soup: OctagonSoup, chunks: Chunks, png: bytes, ids: bool
) -> None:
    with replacing(path) as temporary, temporary.open("wb") as handle:
        handle.write(struct.pack("<4sII", b"glTF", 2, layout.total))
        handle.write(struct.pack("<I4s", layout.json_room, b"JSON"))
        json_start = handle.tell()
        handle.seek(layout.json_room, 1)
        handle.write(struct.pack("<I4s", layout.length, b"BIN\0"))
        for data in _shared_data(layout, png, ids):
            handle.write(data)
        bounds: list[Bounds] = []
        for chunk in chunks:
            batch = soup.batch(chunk)
            for data in _chunk_data(batch, ids):
                handle.write(data)
            corners = batch.corners_world.reshape(-1, 3)
            bounds.append((corners.min(axis=0).tolist(), corners.max(axis=0).tolist()))
        assert handle.tell() == layout.total
        handle.seek(json_start)
        handle.write(layout.json(bounds).ljust(layout.json_room))


def _shared_data(layout: GlbLayout, png: bytes, ids: bool) -> Iterator[bytes]:
    yield png.ljust(padded(len(png)), b"\0")
    yield octagon_triangles(layout.largest).astype("<u4").tobytes()
    if ids:
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


register(Exporter("glb", ("*.glb",), "octagon mesh as GLB with opacity and fall-off, for looking at", write))
