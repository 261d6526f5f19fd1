"""Export as OBJ with vertex colours, an MTL and the radial texture beside it: plain geometry for any program.

OBJ has no opacity per vertex, so the Gaussians' own opacities are lost; the texture keeps the fall-off.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from engine.errors import SceneFileError
from engine.files.octagon_soup import BATCH, OctagonBatch, OctagonSoup
from engine.files.options import ExportOptions
from engine.files.registry import Exporter, register
from engine.files.textures import grey_png
from engine.gaussians.model import FlatGaussians
from engine.gaussians.octagon import SIDES, octagon_triangles
from engine.writing import replacing

MATERIAL = "octagons"
MATERIAL_TEXT = f"newmtl {MATERIAL}\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 0\n"
POSITION_LINE = "v %.9g %.9g %.9g"
COLOUR_END = " %.5g %.5g %.5g\n"
TEXTURE_LINE = "vt %.6f %.6f\n"
FACE_LINE = "f %d/%d %d/%d %d/%d\n"


def write(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write ``path``, ``<stem>.mtl`` and ``<stem>_alpha.png``; coordinates keep every float32 bit."""
    soup = OctagonSoup(gaussians, path, options)
    material, texture = path.with_suffix(".mtl"), path.with_name(f"{path.stem}_alpha.png")
    try:
        with replacing(texture) as temporary:
            temporary.write_bytes(grey_png(options.texture_size, options.q))
        with replacing(material) as temporary:
            temporary.write_text(f"{MATERIAL_TEXT}map_d {texture.name}\n", encoding="utf-8")
        with replacing(path) as temporary, temporary.open("wb") as handle:
            for text in _lines(soup, material.name):
                handle.write(text.encode())
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be written ({error.strerror or error}).") from error
    return path, material, texture


def _lines(soup: OctagonSoup, material_name: str) -> Iterator[str]:
    yield (
        f"# octasplat octagons: {SIDES} vertices and 6 triangles per Gaussian, in the order of the scene\n"
        f"# octasplat_q {soup.q!r}\n# octasplat_gaussians {soup.scene_size}\n"
        f"mtllib {material_name}\no octagons\nusemtl {MATERIAL}\n"
    )
    for batch in soup.batches():
        yield _vertex_lines(batch)
    for start in range(0, len(soup), BATCH):
        count = min(BATCH, len(soup) - start)
        indices = octagon_triangles(count) + (1 + start * SIDES)
        yield FACE_LINE * len(indices) % tuple(np.repeat(indices.reshape(-1), 2).tolist())


def _vertex_lines(batch: OctagonBatch) -> str:
    """The ``v`` and ``vt`` lines of a batch; one big format string beats a call per line many times over."""
    count = len(batch.ids)
    octagons = (POSITION_LINE + "\0") * SIDES * count % tuple(batch.corners_world.reshape(-1).tolist())
    positions = octagons.split("\0")
    colours = [COLOUR_END % tuple(rgb) for rgb in batch.rgb_srgb.tolist()]
    vertices = "".join([positions[k] + colours[k // SIDES] for k in range(count * SIDES)])
    return vertices + TEXTURE_LINE * (count * SIDES) % tuple(batch.uv.reshape(-1).tolist())


register(Exporter("obj", ("*.obj",), "octagon mesh as OBJ with vertex colours, without opacity", write))
