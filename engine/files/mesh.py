"""Meshes that come back from an editor, or that drive a scene, in whatever of three formats."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64, Int64

from engine.errors import SceneFileError


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh, and what else of an octagon mesh survived its way.

    Attributes:
        vertices: positions as the file gives them, with the transforms of glTF nodes applied; which axes they
            are along is :mod:`engine.edit.axes`' business.
        triangles: vertex indices; polygons are cut into fans. Empty for a file of points.
        uv: texture coordinates as the file has them (v may count up or down), or None; NaN where a vertex has
            none, and the last where it has several.
        gid: number of the Gaussian that a vertex belongs to, NaN where the file says none, or None.
        corner: corner number 0 to 7 likewise.
        radius: radius of the octagon in standard deviations likewise.
        q: chi-square quantile of the octagons, where the file still names it.
        rounding: how far a coordinate may be off because of the digits that the file keeps, beyond float32.
    """

    vertices: Float64[np.ndarray, "v 3"]
    triangles: Int64[np.ndarray, "t 3"]
    uv: Float32[np.ndarray, "v 2"] | None = None
    gid: Float32[np.ndarray, " v"] | None = None
    corner: Float32[np.ndarray, " v"] | None = None
    radius: Float32[np.ndarray, " v"] | None = None
    q: float | None = None
    rounding: float = 0.0

    def __len__(self) -> int:
        return len(self.vertices)


MESH_SUFFIXES = (".ply", ".obj", ".glb")


def read_mesh(path: Path) -> Mesh:
    """Read a PLY, OBJ or GLB mesh.

    Raises:
        SceneFileError: another suffix, a file that cannot be read, is damaged or compressed, or has vertices
            that are not finite.
    """
    from engine.files.mesh_glb import read_glb
    from engine.files.mesh_obj import read_obj
    from engine.files.mesh_ply import read_ply_mesh

    readers: dict[str, Callable[[Path], Mesh]] = {".ply": read_ply_mesh, ".obj": read_obj, ".glb": read_glb}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise SceneFileError(f"{path}: is no mesh that is read here; save it as .ply, .obj or .glb.")
    mesh = reader(path)
    if len(mesh) == 0:
        raise SceneFileError(f"{path}: holds no vertices.")
    bad = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
    if bad:
        raise SceneFileError(f"{path}: {bad} of {len(mesh)} vertices are not finite; save the mesh again.")
    if len(mesh.triangles) and not (mesh.triangles.min() >= 0 and mesh.triangles.max() < len(mesh)):
        raise SceneFileError(f"{path}: a face names a vertex that is not there; the file is damaged.")
    return mesh
