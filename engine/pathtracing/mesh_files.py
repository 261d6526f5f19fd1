"""Meshes of a stage as their files hold them, and the check that those of glass are closed.

Imports neither torch nor numba nor scipy: clients and the service check meshes before a job is queued.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.local_origin import NO_ORIGIN, Origin, vertices_about
from octasplat.engine.files import read_mesh
from octasplat.engine.geometry.mesh_material import MeshMaterial
from octasplat.engine.geometry.triangle_mesh import edge_report
from octasplat.engine.pathtracing.stage.materials import Glass
from octasplat.engine.pathtracing.stage.model import StageMesh

WELD_TOLERANCE = 1e-6
"""Points nearer than this share of the mesh's size are one, whatever the file says."""


@dataclass(frozen=True)
class MeshShape:
    """Triangles in their own frame.

    Attributes:
        vertices: positions.
        faces: three vertices each, anticlockwise from outside.
        corner_uv: texture coordinates of the faces' corners, (0, 0) at the upper left, NaN where there are
            none; None without any.
        corner_normals: of the faces' corners, NaN where they are not known; None without any.
        corner_rgb_linear: colors of the faces' corners; None without any.
        corner_alpha: alpha of these colors, NaN where there is none; None without any.
        material_numbers: row of each face in ``materials``, -1 for none; None without any.
        materials: of the file.
        notes: sentences on what of the file's shape is passed over.
    """

    vertices: Float64[np.ndarray, "v 3"]
    faces: Int64[np.ndarray, "f 3"]
    corner_uv: Float32[np.ndarray, "f 3 2"] | None = None
    corner_normals: Float64[np.ndarray, "f 3 3"] | None = None
    corner_rgb_linear: Float32[np.ndarray, "f 3 3"] | None = None
    corner_alpha: Float32[np.ndarray, "f 3"] | None = None
    material_numbers: Int32[np.ndarray, " f"] | None = None
    materials: tuple[MeshMaterial, ...] = ()
    notes: tuple[str, ...] = ()


def read_shape(path: Path) -> MeshShape:
    """Return the triangles of a mesh file with its materials.

    Raises:
        SceneFileError: the file cannot be read.
        ConfigError: it holds no triangles.
    """
    mesh = read_mesh(path, with_materials=True)
    if len(mesh.triangles) == 0:
        raise ConfigError(f"{path}: holds no triangles, so that light has nothing to fall on.")
    return MeshShape(
        vertices=mesh.vertices,
        faces=mesh.triangles,
        corner_uv=mesh.corner_uv,
        corner_normals=None if mesh.corner_normals is None else mesh.corner_normals.astype(np.float64),
        corner_rgb_linear=None if mesh.rgb_linear is None else mesh.rgb_linear[mesh.triangles],
        corner_alpha=None if mesh.alpha is None else mesh.alpha[mesh.triangles],
        material_numbers=mesh.material_indices,
        materials=mesh.materials,
        notes=mesh.notes,
    )


def load_file_shape(
    mesh: StageMesh, number: int, folder: Path, origin_world: Origin = NO_ORIGIN
) -> MeshShape:
    """Return the triangles of the file of mesh ``number`` before placement, with the file's materials.

    Args:
        mesh: has a file.
        number: in the stage, from 0.
        folder: that the name of the file is relative to.
        origin_world: what vertices in large coordinates are about.

    Raises:
        ConfigError: it is of glass and not closed, or holds no triangles.
        SceneFileError: the file cannot be read.
    """
    assert mesh.file is not None
    shape = read_shape(folder / mesh.file)
    shape = replace(shape, vertices=vertices_about(shape.vertices, origin_world))
    if isinstance(mesh.material, Glass) and (count := count_open_edges(shape)):
        raise ConfigError(
            f"meshes[{number}]: {folder / mesh.file} is not closed ({count:,} edges without two faces that "
            "wind alike), so that it cannot be glass; close it or choose another material."
        )
    return shape


def check_glass_is_closed(meshes: Mapping[int, StageMesh], folder: Path) -> None:
    """Check meshes of :func:`octasplat.engine.pathtracing.stage.stage_file.glass_meshes`.

    Args:
        meshes: by their numbers in the stage.
        folder: that the names of their files are relative to.

    Raises:
        ConfigError: one is not closed, or holds no triangles.
        SceneFileError: one cannot be read.
    """
    for number, mesh in meshes.items():
        load_file_shape(mesh, number, folder)


def count_open_edges(shape: MeshShape, face_mask: Bool[np.ndarray, " f"] | None = None) -> int:
    """Return the number of edges not shared by two consistently wound faces; a closed mesh has none.

    Vertices that lie in one place count as one, as in files that repeat them for normals and textures.
    """
    chosen = shape.faces if face_mask is None else shape.faces[face_mask]
    faces = weld_vertices(shape.vertices)[chosen].astype(np.int32)
    # faces welded to a line have edges of their own, which are no holes
    sound = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    report = edge_report(faces[sound])
    return report.open_edges + report.non_manifold_edges + report.inconsistent_edges


def weld_vertices(vertices: Float64[np.ndarray, "v 3"]) -> Int64[np.ndarray, " v"]:
    """Return the same number for vertices that lie in one place."""
    size = max(float(np.ptp(vertices, axis=0).max()), 1e-30)
    _, owner = np.unique(
        np.round(vertices / (WELD_TOLERANCE * size)).astype(np.int64), axis=0, return_inverse=True
    )
    return owner.reshape(-1)
