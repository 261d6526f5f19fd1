"""Meshes as PLY: octagons of a scene out, surfaces out, edited meshes in.

Octagons: the format to edit in, as mesh editors keep vertex attributes both ways; they are found by name.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int, Int64

from octasplat.engine.core.color import srgb_to_linear, to_bytes
from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.ply_container import (
    COUNT_SUFFIX,
    PlyWriteElement,
    columns,
    list_field,
    read_ply,
    write_ply,
)
from octasplat.engine.files.export_options import ExportOptions
from octasplat.engine.files.gaussian_ply import channel_comments
from octasplat.engine.files.octagon_batches import BATCH_SIZE, OctagonSoup
from octasplat.engine.files.place_comments import place_comments
from octasplat.engine.files.registry import Exporter, MeshReader, SurfaceWriter, register
from octasplat.engine.gaussians.channels import column_names
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import FAN_TRIANGLES, SIDES, octagon_triangles
from octasplat.engine.geometry.imported_mesh import (
    MIN_OPACITY_KEY,
    Q_KEY,
    SCENE_SIZE_KEY,
    ImportedMesh,
    flip_v,
    number_in_comments,
    scene_size_of,
)
from octasplat.engine.geometry.polygons import fan_places, triangle_places
from octasplat.engine.geometry.triangle_mesh import TriangleMesh

_POSITION, _NORMAL = ("x", "y", "z"), ("nx", "ny", "nz")
COLORS = ("red", "green", "blue")
PATTERNS = (
    *("mesh.ply", "*.mesh.ply", "*_mesh.ply", "*-mesh.ply"),
    *("octagons.ply", "*.octagons.ply", "*_octagons.ply", "*-octagons.ply"),
)
_IMAGE = re.compile(r"TextureFile\s+\S", re.IGNORECASE)
"""How comments of photogrammetry programs begin that name an image."""
_FACE_LISTS = ("vertex_indices", "vertex_index")
VERTEX = [
    *((name, "<f4") for name in (*_POSITION, "s", "t")),
    *((name, "u1") for name in (*COLORS, "alpha")),
    *((name, "<f4") for name in ("gid", "corner", "radius")),
]
FACE = np.dtype(list_field("vertex_indices", "i4", 3))


def read(path: Path) -> ImportedMesh:
    """Read a PLY mesh; faces may be triangles or polygons, all of one length.

    Raises:
        SceneFileError: no PLY, no positions, Gaussians instead of a mesh, or faces of several lengths.
    """
    header, tables = read_ply(path, ["vertex"])
    vertex = header.element("vertex")
    assert vertex is not None
    if "f_dc_0" in vertex.names:
        raise SceneFileError(
            f"{path}: is a file of Gaussians, not a mesh; name the mesh that was exported and edited."
        )
    # Some programs write colors and the like as lists, which nothing here needs.
    numbers = [prop.name for prop in vertex.properties if prop.count_kind is None]
    missing = [name for name in _POSITION if name not in numbers]
    if missing:
        raise SceneFileError(f"{path}: is no mesh; its vertices lack the property {', '.join(missing)}.")
    table = tables["vertex"][numbers]
    face = header.element("face")
    positions = np.empty((len(table), 3))
    for axis, coordinate in enumerate(_POSITION):
        positions[:, axis] = table[coordinate]
    triangles = np.zeros((0, 3), np.int64)
    if face is not None and face.count:
        name = next((prop.name for prop in face.lists if prop.name in _FACE_LISTS), None)
        if name is None:
            raise SceneFileError(f"{path}: its faces have no list 'vertex_indices'.")
        polygons = np.asarray(read_ply(path, ["face"])[1]["face"][name]).astype(np.int64)
        triangles = _triangles_of(polygons, positions)
    return ImportedMesh(
        positions,
        triangles,
        uv=columns(table, ("s", "t")) if {"s", "t"} <= set(numbers) else None,
        gid=_find_attribute(table, "gid"),
        corner=_find_attribute(table, "corner"),
        radius=_find_attribute(table, "radius"),
        q=number_in_comments(header.comments, Q_KEY),
        min_opacity=number_in_comments(header.comments, MIN_OPACITY_KEY),
        scene_size=scene_size_of(number_in_comments(header.comments, SCENE_SIZE_KEY)),
    )


def read_with_materials(path: Path) -> ImportedMesh:
    """Read the triangles of a PLY with normals and colors; it has no materials.

    Raises:
        SceneFileError: likewise.
    """
    mesh = read(path)
    if mesh.triangles.max(initial=-1) >= len(mesh) or mesh.triangles.min(initial=0) < 0:
        return mesh  # damaged, which is told for all formats alike
    header, tables = read_ply(path, ["vertex"])
    table, vertex = tables["vertex"], header.element("vertex")
    assert vertex is not None
    names = {prop.name for prop in vertex.properties if prop.count_kind is None}
    uv = mesh.uv
    if uv is None and {"u", "v"} <= names:  # other programs' names of s and t
        uv = columns(table, ("u", "v"))
    colors = None
    if set(COLORS) <= names:
        colors = columns(table, COLORS)
        if table.dtype["red"].kind in "iu":
            colors = colors / np.float32(np.iinfo(table.dtype["red"]).max)
        colors = srgb_to_linear(np.clip(colors, 0.0, 1.0)).astype(np.float32)
    images = [comment.split(maxsplit=1)[1] for comment in header.comments if _IMAGE.match(comment)]
    notes = (f"Its image {', '.join(images)} is passed over: a PLY has no materials.",) if images else ()
    return replace(
        mesh,
        notes=notes,
        corner_uv=None if uv is None else flip_v(uv)[mesh.triangles],
        corner_normals=columns(table, _NORMAL)[mesh.triangles] if set(_NORMAL) <= names else None,
        rgb_linear=colors,
    )


def _triangles_of(
    polygons: Int64[np.ndarray, "p c"], positions: Float64[np.ndarray, "v 3"]
) -> Int64[np.ndarray, "t 3"]:
    sides = polygons.shape[1]
    if sides == 3:
        return polygons
    fan = fan_places(sides)
    # what names no vertex is refused by whoever reads the mesh
    if sides < 4 or not (polygons.min() >= 0 and polygons.max() < len(positions)):
        return polygons[:, fan].reshape(-1, 3)
    places = triangle_places(positions[polygons]).reshape(len(polygons), -1)
    return np.take_along_axis(polygons, places, axis=1).reshape(-1, 3)


def _find_attribute(table: np.ndarray, name: str) -> Float32[np.ndarray, " v"] | None:
    """Return a vertex attribute under its own name, or under that of the GLB, which Blender takes over."""
    for known in (name, f"_{name.upper()}"):
        if known in (table.dtype.names or ()):
            return columns(table, (known,))[:, 0]
    return None


def write_octagons(gaussians: FlatGaussians, path: Path, options: ExportOptions) -> tuple[Path, ...]:
    """Write eight vertices and six triangles per Gaussian.

    Per vertex: position (world), texture coordinates ``s t``, display color and opacity as bytes, and as
    floats ``gid`` (number of the Gaussian), ``corner`` (0 to 7), ``radius`` (of the corners, in standard
    deviations) and the Gaussian's channels.
    """
    soup = OctagonSoup(gaussians, path, options)
    count = len(soup)
    widths = soup.channel_widths
    comments = (
        "octasplat octagons",
        f"{Q_KEY} {options.q!r}",
        f"{MIN_OPACITY_KEY} {options.min_opacity!r}",
        f"{SCENE_SIZE_KEY} {soup.scene_size}",
        *channel_comments(widths),
        *place_comments(options.facts.origin_world, options.facts.georeference),
    )
    names = [column for name, width in widths.items() for column in column_names(name, width)]
    vertex = np.dtype([*VERTEX, *((name, "<f4") for name in names)])
    vertices = PlyWriteElement("vertex", count * SIDES, vertex, _vertex_batches(soup, vertex))
    faces = PlyWriteElement("face", count * len(FAN_TRIANGLES), FACE, _face_batches(count))
    write_ply(path, [vertices, faces], comments)
    return (path,)


def _vertex_batches(soup: OctagonSoup, vertex: np.dtype[np.void]) -> Iterator[np.ndarray]:
    for batch in soup.batches():
        rows = np.empty((len(batch.ids), SIDES), dtype=vertex)
        for axis, name in enumerate(_POSITION):
            rows[name] = batch.corners_world[..., axis]
        rows["s"], rows["t"] = batch.uv[..., 0], batch.uv[..., 1]
        rgba = to_bytes(np.concatenate([batch.rgb_srgb, batch.opacities[:, None]], axis=1))
        for channel, name in enumerate((*COLORS, "alpha")):
            rows[name] = rgba[:, channel, None]
        rows["gid"] = batch.ids[:, None]
        rows["corner"] = np.arange(SIDES)
        rows["radius"] = batch.radii[:, None]
        for name, values in batch.channels.items():
            for place, column in enumerate(column_names(name, values.shape[1])):
                rows[column] = values[:, place, None]
        yield rows.reshape(-1)


def _face_batches(count: int) -> Iterator[np.ndarray]:
    for start in range(0, count, BATCH_SIZE):
        yield _face_rows(octagon_triangles(min(BATCH_SIZE, count - start)) + start * SIDES)


def write_surface(
    mesh: TriangleMesh, path: Path, _turn_xyzw: Sequence[float] | None = None
) -> tuple[Path, ...]:
    """Write a surface with its normals and the colors of its vertices, if it has some, in the scene's frame.

    Raises:
        SceneFileError: the file cannot be written.
    """
    colors = COLORS if mesh.rgb_srgb is not None else ()
    rows = np.empty(
        len(mesh.vertices_world),
        dtype=[*((name, "<f4") for name in (*_POSITION, *_NORMAL)), *((name, "u1") for name in colors)],
    )
    vectors = np.concatenate([mesh.vertices_world, mesh.vertex_normals()], axis=1)
    for column, name in enumerate((*_POSITION, *_NORMAL)):
        rows[name] = vectors[:, column]
    if mesh.rgb_srgb is not None:
        for column, name in enumerate(colors):
            rows[name] = to_bytes(mesh.rgb_srgb[:, column])
    vertices = PlyWriteElement("vertex", len(rows), rows.dtype, [rows])
    faces = PlyWriteElement("face", len(mesh.faces), FACE, [_face_rows(mesh.faces)])
    place = place_comments(mesh.origin_world, mesh.georeference)
    write_ply(path, [vertices, faces], ["octasplat surface", *place])
    return (path,)


def _face_rows(triangles: Int[np.ndarray, "t 3"]) -> np.ndarray:
    rows = np.empty(len(triangles), dtype=FACE)
    rows["vertex_indices" + COUNT_SUFFIX] = 3
    rows["vertex_indices"] = triangles
    return rows


register(
    Exporter(
        "mesh-ply",
        PATTERNS,
        "octagon mesh as a binary PLY with Gaussian numbers, for editing",
        write_octagons,
        holds_channels=True,
        holds_origin=True,
    )
)
register(MeshReader("mesh-ply", ("*.ply",), read, read_with_materials))
register(SurfaceWriter("mesh-ply", ("*.ply",), write_surface, textured=False))
