"""Meshes as OBJ: octagons of a scene out, surfaces out, edited meshes in.

Octagons: plain geometry for any program, with vertex colors, an MTL and the radial texture beside it. OBJ
has no opacity per vertex, so the Gaussians' own opacities are lost; the texture keeps the fall-off.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.writing import atomic_replace, write_text
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.obj_materials import (
    UNKNOWN_RGB_LINEAR,
    library_names,
    missing_libraries,
    read_mtl,
)
from octasplat.engine.files.obj_parser import (
    ObjParts,
    corner_values,
    cut_concave_polygons,
    parse_block,
    read_blocks,
    uv_of_vertices,
)
from octasplat.engine.files.octagon_batches import BATCH_SIZE, OctagonBatch, OctagonSoup
from octasplat.engine.files.place_comments import place_comments
from octasplat.engine.files.registry import Exporter, MeshReader, SurfaceWriter, register
from octasplat.engine.files.textures import grey_png, png_bytes
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import SIDES, octagon_triangles
from octasplat.engine.geometry.imported_mesh import (
    MIN_OPACITY_KEY,
    Q_KEY,
    SCENE_SIZE_KEY,
    ImportedMesh,
    flip_v,
    number_in_comments,
    scene_size_of,
)
from octasplat.engine.geometry.mesh_material import MeshMaterial
from octasplat.engine.geometry.triangle_mesh import TriangleMesh

LINES_PER_BLOCK = 100_000
MATERIAL = "octagons"
POSITION_LINE = "v %.9g %.9g %.9g"
COLOR_END = " %.5g %.5g %.5g\n"
TEXTURE_LINE = "vt %.6f %.6f\n"
FACE_LINE = "f %d/%d %d/%d %d/%d\n"


def read(path: Path) -> ImportedMesh:
    """Read positions, texture coordinates and faces of an OBJ; colors, normals and groups are passed over.

    Raises:
        SceneFileError: the file cannot be read, or a line is not understood.
    """
    return _read(path, ObjParts())


def read_with_materials(path: Path) -> ImportedMesh:
    """Read the triangles of an OBJ with texture coordinates and normals of corners, colors and materials.

    Raises:
        SceneFileError: likewise, or an image that its MTL names is missing.
    """
    return _read(path, ObjParts(with_materials=True))


def _read(path: Path, parts: ObjParts) -> ImportedMesh:
    try:
        with path.open("rb") as handle:
            for block in read_blocks(handle):
                parse_block(path, block, parts)
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be read ({error.strerror or error}).") from error
    if not parts.positions:
        raise SceneFileError(f"{path}: is no OBJ mesh; it has no line that begins with 'v'.")
    positions = np.concatenate(parts.positions)
    parts.positions.clear()  # or they are in memory twice
    cut_concave_polygons(parts, positions)
    uv = uv_of_vertices(path, parts, len(positions))
    materials = _read_materials(path, parts, len(positions)) if parts.with_materials else {}
    parts.uv.clear()
    parts.triangle_uv.clear()
    parts.triangle_normals.clear()
    triangles = np.concatenate([*parts.triangles, np.zeros((0, 3), np.int32)], dtype=np.int64)
    rounding = 0.5 * 10.0**-parts.decimals  # half a unit of the last digit
    return ImportedMesh(
        positions,
        triangles,
        uv=uv,
        q=number_in_comments(tuple(parts.comments), Q_KEY),
        min_opacity=number_in_comments(tuple(parts.comments), MIN_OPACITY_KEY),
        scene_size=scene_size_of(number_in_comments(tuple(parts.comments), SCENE_SIZE_KEY)),
        rounding=rounding,
        **materials,
    )


def _read_materials(path: Path, parts: ObjParts, count: int) -> dict[str, Any]:
    """Return texture coordinates and normals of corners, colors of vertices and materials."""
    uv = [flip_v(values) for values in parts.uv]
    looks: dict[str, Any] = {
        "corner_uv": corner_values(path, uv, parts.triangle_uv, "texture coordinate"),
        "corner_normals": corner_values(path, parts.normals, parts.triangle_normals, "normal"),
    }
    # Only where every vertex has a color, as they are told apart by their order
    if sum(map(len, parts.colors)) == count:
        looks["rgb_linear"] = srgb_to_linear(np.clip(np.concatenate(parts.colors), 0, 1)).astype(np.float32)
    if parts.material_uses:
        known = {name: k for k, name in enumerate(dict.fromkeys(name for _, name in parts.material_uses))}
        libraries = library_names(path, parts.libraries)
        materials = read_mtl(path, libraries)
        numbers = np.full(parts.triangle_count, -1, np.int32)
        # Each use holds until the next one.
        for start, name in parts.material_uses:
            numbers[start:] = known[name]
        lost = missing_libraries(path, libraries)
        why = f"{', '.join(lost)} is not in the folder of the OBJ" if lost else "no MTL file has one"
        # Colors of vertices are multiplied by that of the material.
        grey = (1.0, 1.0, 1.0) if "rgb_linear" in looks else UNKNOWN_RGB_LINEAR
        missing = MeshMaterial("", grey, unsupported=(f"its entry, as {why}",))
        looks["material_indices"] = numbers
        looks["materials"] = tuple(materials.get(name, replace(missing, name=name)) for name in known)
    return looks


def write_octagons(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write ``path``, ``<stem>.mtl`` and ``<stem>_alpha.png``; coordinates keep every float32 bit.

    Raises:
        SceneFileError: nothing to write, or values that are not finite.
        OSError: a file cannot be written.
    """
    soup = OctagonSoup(gaussians, path, options)
    material, texture = _octagon_files(path)
    # What the OBJ names is written before it.
    with atomic_replace(texture) as temporary:
        temporary.write_bytes(grey_png(options.falloff_texture_size, options.q))
    write_text(material, f"{_material_entry(MATERIAL)}map_d {texture.name}\n")
    with atomic_replace(path) as temporary, temporary.open("wb") as handle:
        for text in _octagon_lines(
            soup, material.name, place_comments(options.facts.origin_world, options.facts.georeference)
        ):
            handle.write(text.encode())
    return path, material, texture


def _material_entry(name: str) -> str:
    return f"newmtl {name}\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 0\n"


def _comment_lines(comments: Sequence[str]) -> str:
    return "".join(f"# {comment}\n" for comment in comments)


def _octagon_lines(soup: OctagonSoup, material_name: str, place: Sequence[str]) -> Iterator[str]:
    yield (
        f"# octasplat octagons: {SIDES} vertices and 6 triangles per Gaussian, in the order of the scene\n"
        f"# {Q_KEY} {soup.q!r}\n# {MIN_OPACITY_KEY} {soup.min_opacity!r}\n"
        f"# {SCENE_SIZE_KEY} {soup.scene_size}\n{_comment_lines(place)}"
        f"mtllib {material_name}\no octagons\nusemtl {MATERIAL}\n"
    )
    for batch in soup.batches():
        yield _vertex_lines(batch)
    for start in range(0, len(soup), BATCH_SIZE):
        count = min(BATCH_SIZE, len(soup) - start)
        # Numbers begin at 1; positions and texture coordinates have the same ones.
        indices = octagon_triangles(count) + (1 + start * SIDES)
        yield FACE_LINE * len(indices) % tuple(np.repeat(indices.reshape(-1), 2).tolist())


def _vertex_lines(batch: OctagonBatch) -> str:
    """Return the ``v`` and ``vt`` lines of a batch.

    One big format string beats a call per line many times over.
    """
    count = len(batch.ids)
    octagons = (POSITION_LINE + "\0") * SIDES * count % tuple(batch.corners_world.reshape(-1).tolist())
    positions = octagons.split("\0")
    colors = [COLOR_END % tuple(rgb) for rgb in batch.rgb_srgb.tolist()]
    vertices = "".join([positions[k] + colors[k // SIDES] for k in range(count * SIDES)])
    return vertices + TEXTURE_LINE * (count * SIDES) % tuple(batch.uv.reshape(-1).tolist())


def write_surface(
    mesh: TriangleMesh, path: Path, _turn_xyzw: Sequence[float] | None = None
) -> tuple[Path, ...]:
    """Write a surface; vertex colors stand behind the positions, a texture in an MTL and a PNG beside it.

    It stays in the frame of the scene.

    Raises:
        OSError: a file cannot be written.
    """
    place = place_comments(mesh.origin_world, mesh.georeference)
    head, files = f"# octasplat surface\n{_comment_lines(place)}", [path]
    if mesh.texture_srgb is not None:
        material, image = _surface_files(path)
        with atomic_replace(image) as temporary:
            temporary.write_bytes(png_bytes(mesh.texture_srgb))
        write_text(material, f"{_material_entry('surface')}map_Kd {image.name}\n")
        head += f"mtllib {material.name}\nusemtl surface\n"
        files += [material, image]
    with atomic_replace(path) as temporary, temporary.open("w", encoding="utf-8") as handle:
        handle.write(head)
        vertices = (
            mesh.vertices_world if mesh.rgb_srgb is None else np.hstack([mesh.vertices_world, mesh.rgb_srgb])
        )
        _write_lines(handle.write, "v %.7g %.7g %.7g" + " %.4g" * (vertices.shape[1] - 3), vertices)
        numbers = mesh.faces.astype(np.int64) + 1
        if mesh.uv is None:
            _write_lines(handle.write, "f %d %d %d", numbers)
        else:
            _write_lines(handle.write, "vt %.7g %.7g", mesh.uv * [1, -1] + [0, 1])  # from the lower left
            _write_lines(handle.write, "f %d/%d %d/%d %d/%d", np.repeat(numbers, 2, axis=1))
    return tuple(files)


def _octagon_files(path: Path) -> tuple[Path, Path]:
    """Return the files of the material and the texture of octagons."""
    return path.with_suffix(".mtl"), path.with_name(f"{path.stem}_alpha.png")


def _surface_files(path: Path) -> tuple[Path, Path]:
    """Return the files of the material and the texture of a surface."""
    return path.with_suffix(".mtl"), path.with_suffix(".png")


def _write_lines(write: Callable[[str], object], line: str, rows: np.ndarray) -> None:
    for start in range(0, len(rows), LINES_PER_BLOCK):
        part = rows[start : start + LINES_PER_BLOCK]
        write((line + "\n") * len(part) % tuple(part.reshape(-1).tolist()))


register(
    Exporter(
        "obj",
        ("*.obj",),
        "octagon mesh as OBJ with vertex colors, without opacity",
        write_octagons,
        beside=_octagon_files,
        holds_origin=True,
    )
)
register(MeshReader("obj", ("*.obj",), read, read_with_materials))
register(SurfaceWriter("obj", ("*.obj",), write_surface, textured=True, beside=_surface_files))
