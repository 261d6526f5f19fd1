"""Export as a binary PLY of octagons: the format to edit in, as mesh editors keep its ids both ways."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from engine.colour import to_bytes
from engine.files.octagon_soup import BATCH, OctagonSoup
from engine.files.options import ExportOptions
from engine.files.ply_container import COUNT_SUFFIX, PlyWriteElement, list_field, write_ply
from engine.files.registry import Exporter, register
from engine.gaussians.model import FlatGaussians
from engine.gaussians.octagon import FAN, SIDES, octagon_triangles

VERTEX = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "s", "t")),
        *((name, "u1") for name in ("red", "green", "blue", "alpha")),
        *((name, "<f4") for name in ("gid", "corner", "radius")),
    ]
)
FACE = np.dtype(list_field("vertex_indices", "i4", 3))


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write eight vertices and six triangles per Gaussian.

    Per vertex: position (world), texture coordinates ``s t``, display colour and opacity as bytes, and as
    floats ``gid`` (number of the Gaussian), ``corner`` (0 to 7) and ``radius`` (of the corners, in standard
    deviations).
    """
    soup = OctagonSoup(gaussians, path, options)
    count = len(soup)
    comments = ("octasplat octagons", f"octasplat_q {options.q!r}", f"octasplat_gaussians {soup.scene_size}")
    vertices = PlyWriteElement("vertex", count * SIDES, VERTEX, _vertices(soup))
    faces = PlyWriteElement("face", count * len(FAN), FACE, _faces(count))
    write_ply(path, [vertices, faces], comments)
    return (path,)


def _vertices(soup: OctagonSoup) -> Iterator[np.ndarray]:
    for batch in soup.batches():
        rows = np.empty((len(batch.ids), SIDES), dtype=VERTEX)
        for axis, name in enumerate(("x", "y", "z")):
            rows[name] = batch.corners_world[..., axis]
        rows["s"], rows["t"] = batch.uv[..., 0], batch.uv[..., 1]
        rgba = to_bytes(np.concatenate([batch.rgb_srgb, batch.opacities[:, None]], axis=1))
        for channel, name in enumerate(("red", "green", "blue", "alpha")):
            rows[name] = rgba[:, channel, None]
        rows["gid"] = batch.ids[:, None]
        rows["corner"] = np.arange(SIDES)
        rows["radius"] = batch.radii[:, None]
        yield rows.reshape(-1)


def _faces(count: int) -> Iterator[np.ndarray]:
    for start in range(0, count, BATCH):
        indices = octagon_triangles(min(BATCH, count - start)) + start * SIDES
        rows = np.empty(len(indices), dtype=FACE)
        rows["vertex_indices" + COUNT_SUFFIX] = 3
        rows["vertex_indices"] = indices
        yield rows


register(
    Exporter(
        "mesh-ply",
        ("mesh.ply", "*.mesh.ply", "*_mesh.ply", "*-mesh.ply"),
        "octagon mesh as a binary PLY with Gaussian numbers, for editing",
        write,
    )
)
