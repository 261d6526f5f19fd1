"""Meshes from PLY, with the vertex attributes of our octagon mesh by their names."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64

from engine.errors import SceneFileError
from engine.files.mesh import Mesh
from engine.files.ply_container import columns, read_ply

_POSITION = ("x", "y", "z")
_FACE_LISTS = ("vertex_indices", "vertex_index")


def read_ply_mesh(path: Path) -> Mesh:
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
    missing = [name for name in _POSITION if name not in vertex.names]
    if missing or vertex.lists:
        raise SceneFileError(f"{path}: is no mesh; its vertices lack the property {', '.join(missing)}.")
    table = tables["vertex"]
    face = header.element("face")
    triangles = np.zeros((0, 3), np.int64)
    if face is not None and face.count:
        name = next((prop.name for prop in face.lists if prop.name in _FACE_LISTS), None)
        if name is None:
            raise SceneFileError(f"{path}: its faces have no list 'vertex_indices'.")
        triangles = _fans(np.asarray(read_ply(path, ["face"])[1]["face"][name]))
    positions = np.empty((len(table), 3))
    for axis, name in enumerate(_POSITION):
        positions[:, axis] = table[name]
    return Mesh(
        positions,
        triangles,
        uv=columns(table, ("s", "t")) if {"s", "t"} <= set(vertex.names) else None,
        gid=_attribute(table, "gid"),
        corner=_attribute(table, "corner"),
        radius=_attribute(table, "radius"),
        q=stated_q(header.comments),
    )


def stated_q(comments: tuple[str, ...]) -> float | None:
    """The chi-square quantile that our exporters write as a comment, or None."""
    for comment in comments:
        words = comment.split()
        if len(words) == 2 and words[0] == "octasplat_q":
            try:
                return float(words[1])
            except ValueError:
                return None
    return None


def _fans(polygons: np.ndarray) -> Int64[np.ndarray, "t 3"]:
    sides = polygons.shape[1]
    if sides < 3:
        return np.zeros((0, 3), np.int64)
    if sides == 3:
        return polygons.astype(np.int64)
    fan = np.array([[0, k, k + 1] for k in range(1, sides - 1)])
    return polygons.astype(np.int64)[:, fan].reshape(-1, 3)


def _attribute(table: np.ndarray, name: str) -> Float32[np.ndarray, " v"] | None:
    """A vertex attribute under its own name, or under that of the GLB, from which Blender takes it over."""
    for known in (name, f"_{name.upper()}"):
        if known in (table.dtype.names or ()):
            return columns(table, (known,))[:, 0]
    return None
