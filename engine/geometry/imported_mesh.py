"""Imported meshes, from an editor or as a proxy, of any file format."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from octasplat.engine.core.local_origin import Origin, is_set, vertices_about
from octasplat.engine.geometry.mesh_material import MeshMaterial


@dataclass(frozen=True)
class ImportedMesh:
    """A triangle mesh, and the octagon attributes that survived the editor.

    Attributes:
        vertices: positions as the file gives them, with the transforms of glTF nodes applied; which axes they
            are along is :mod:`octasplat.engine.edit.axes`' business.
        triangles: vertex indices; polygons are cut into fans, or otherwise where they are not convex. Empty
            for a file of points.
        uv: texture coordinates as the file has them (v may count up or down), or None; NaN where a vertex has
            none, and the last where it has several.
        gid: number of the Gaussian that a vertex belongs to, NaN where the file says none, or None.
        corner: corner number 0 to 7 likewise.
        radius: radius of the octagon in standard deviations likewise.
        q: chi-square quantile of the octagons, where the file still names it.
        min_opacity: octagons were made of Gaussians at least this opaque, where the file still says so.
        scene_size: number of Gaussians of the exported scene, where the file still says so.
        alpha_cutoff: octagons were made no larger than what reaches this alpha, where the file still says it.
        part: place of the file among those of its scene, from 1, and their number; None if it is alone.
        rounding: how far a coordinate may be off because of the digits that the file keeps, beyond float32.
        corner_uv: of a mesh read with its looks: texture coordinates of the triangles' corners, (0, 0) at the
            upper left, NaN where there are none; None without any.
        corner_normals: likewise, normals of the triangles' corners, of any length, NaN where there are none.
        rgb_linear: likewise, colors of the vertices.
        alpha: likewise, the alpha of these colors, NaN where a vertex has none.
        material_indices: likewise, row of each triangle in ``materials``, -1 for none.
        materials: likewise, those that the file gives.
        notes: likewise, sentences on what of the file's shape is passed over.
    """

    vertices: Float64[np.ndarray, "v 3"]
    triangles: Int64[np.ndarray, "t 3"]
    uv: Float32[np.ndarray, "v 2"] | None = None
    gid: Float32[np.ndarray, " v"] | None = None
    corner: Float32[np.ndarray, " v"] | None = None
    radius: Float32[np.ndarray, " v"] | None = None
    q: float | None = None
    min_opacity: float | None = None
    scene_size: int | None = None
    alpha_cutoff: float | None = None
    part: tuple[int, int] | None = None
    rounding: float = 0.0
    corner_uv: Float32[np.ndarray, "t 3 2"] | None = None
    corner_normals: Float32[np.ndarray, "t 3 3"] | None = None
    rgb_linear: Float32[np.ndarray, "v 3"] | None = None
    alpha: Float32[np.ndarray, " v"] | None = None
    material_indices: Int32[np.ndarray, " t"] | None = None
    materials: tuple[MeshMaterial, ...] = ()
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.vertices)

    def about(self, origin: Origin, *, has_same_axes: bool = False) -> "ImportedMesh":
        """Return the mesh about the local origin of a scene, whichever coordinates its file has.

        Args:
            origin: of the scene.
            has_same_axes: whether the mesh is along the axes of the scene, as no program turned it.
        """
        if not is_set(origin):
            return self
        return replace(self, vertices=vertices_about(self.vertices, origin, has_same_axes=has_same_axes))


def flip_v(uv: Float32[np.ndarray, "v 2"]) -> Float32[np.ndarray, "v 2"]:
    """Return texture coordinates with v counted from the top, where a file counts from the bottom.

    >>> flip_v(np.array([[0.25, 0.0], [0.5, 0.75]], np.float32))
    array([[0.25, 1.  ],
           [0.5 , 0.25]], dtype=float32)
    """
    return uv * np.array([1, -1], np.float32) + np.array([0, 1], np.float32)


Q_KEY = "octasplat_q"
SCENE_SIZE_KEY = "octasplat_gaussians"
MIN_OPACITY_KEY = "octasplat_min_opacity"
ALPHA_CUTOFF_KEY = "octasplat_opaque_cutoff"


def scene_size_of(stated: object) -> int | None:
    """Return the size of the scene that a file states, or None where it states none.

    >>> scene_size_of(12.0), scene_size_of(None), scene_size_of("twelve")
    (12, None, None)
    """
    return int(stated) if isinstance(stated, int | float) and stated > 0 else None


def number_in_comments(comments: tuple[str, ...], name: str) -> float | None:
    """Return the number that our exporters write under ``name`` in a comment, or None.

    >>> number_in_comments(("made by octasplat", "q 11.5"), "q")
    11.5
    """
    for comment in comments:
        words = comment.split()
        if len(words) == 2 and words[0] == name:
            try:
                return float(words[1])
            except ValueError:
                return None
    return None
