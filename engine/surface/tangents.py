"""Texture tangents of a mesh, as renderers compute them for normal maps.

After "Simulation of Wrinkled Surfaces Revisited" (Mikkelsen 2008,
http://image.diku.dk/projects/media/morten.mikkelsen.08.pdf), the default of glTF and Blender: at each vertex
the directions in which u grows on the triangles around it, made level with its normal, averaged by the angles
of their corners there.
"""

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.geometry.triangle_mesh import TriangleMesh


def vertex_tangents(mesh: TriangleMesh) -> Float32[np.ndarray, "n 4"]:
    """Return the tangents of a mesh with texture coordinates.

    Args:
        mesh: cut open at its seams. A vertex at which triangles that lie mirrored in the texture meet others
            takes its tangent from those whose angles are larger together.

    Returns:
        Unit vectors in the world, and the sign of normal x tangent that points up in the image.
    """
    assert mesh.uv is not None
    corners, normals = mesh.face_corners_world, mesh.vertex_normals().astype(np.float64)
    uv = mesh.uv.astype(np.float64)[mesh.faces] * [1, -1]  # v grows upwards from here on
    (ab, ac), (s_ab, s_ac) = (np.moveaxis(of[:, 1:] - of[:, :1], 1, 0) for of in (corners, uv))
    area = s_ab[:, 0] * s_ac[:, 1] - s_ab[:, 1] * s_ac[:, 0]
    along = ab * s_ac[:, 1:] - ac * s_ab[:, 1:]  # dP/du times the area in the texture
    side = np.where(area >= 0, 1.0, -1.0)
    along *= side[:, None]
    sums = np.zeros((2, len(normals), 3))
    angles = np.zeros((2, len(normals)))
    for k in range(3):
        vertex = mesh.faces[:, k]
        normal = normals[vertex]
        one, two = (
            _normalize_vectors(_perpendicular_part(corners[:, (k + j) % 3] - corners[:, k], normal))
            for j in (1, 2)
        )
        angle = np.arccos(np.clip((one * two).sum(axis=1), -1.0, 1.0)) * (area != 0)
        share = angle[:, None] * _normalize_vectors(_perpendicular_part(along, normal))
        # mirrored triangles apart: averaged with others they would cancel
        for row, sign in enumerate((1.0, -1.0)):
            mine = side == sign
            angles[row] += np.bincount(vertex[mine], angle[mine], len(normals))
            for axis in range(3):
                sums[row, :, axis] += np.bincount(vertex[mine], share[mine, axis], len(normals))
    mirrored = angles[1] > angles[0]
    tangents = _normalize_vectors(np.where(mirrored[:, None], sums[1], sums[0]))
    lost = (tangents == 0).all(axis=1)  # no texture area: any direction along the surface
    tangents[lost] = _normalize_vectors(
        np.cross(normals[lost], np.eye(3)[np.argmin(np.abs(normals[lost]), axis=1)])
    )
    return np.concatenate([tangents, np.where(mirrored, -1.0, 1.0)[:, None]], axis=1).astype(np.float32)


def world_to_tangent(
    wanted_world: Float64[np.ndarray, "n 3"],
    normals_world: Float64[np.ndarray, "n 3"],
    tangents: Float64[np.ndarray, "n 4"],
) -> Float64[np.ndarray, "n 3"]:
    """Return unit vectors in the tangent frame of a surface, interpolated between its vertices.

    Args:
        wanted_world: unit vectors.
        normals_world: unit normals of the surface.
        tangents: of the surface, with the side in the fourth column, not of unit length.
    """
    tangent = _normalize_vectors(tangents[:, :3])
    bitangent = _normalize_vectors(np.cross(normals_world, tangent)) * np.sign(tangents[:, 3:])
    frame = np.stack([tangent, bitangent, normals_world], axis=2)
    # Between vertices the tangent is not quite level.
    is_regular = np.abs(np.linalg.det(frame)) > 1e-3
    frame[~is_regular] = np.eye(3)
    local = np.linalg.solve(frame, wanted_world[:, :, None])[:, :, 0]
    local[~is_regular] = (0.0, 0.0, 1.0)
    return _normalize_vectors(local)


def _perpendicular_part(
    vectors: Float64[np.ndarray, "n 3"], normals: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    return vectors - (vectors * normals).sum(axis=1, keepdims=True) * normals


def _normalize_vectors(vectors: Float64[np.ndarray, "n 3"]) -> Float64[np.ndarray, "n 3"]:
    """Return vectors of length 1; those of length 0 stay so."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 1e-30)
