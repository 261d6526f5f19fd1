"""Meshes of a stage: primitives, placement, smooth normals, and the outside of solids."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from octasplat.engine.pathtracing.kernels.smooth_normals import smooth_normals
from octasplat.engine.pathtracing.mesh_files import WELD_TOLERANCE, MeshShape, weld_vertices
from octasplat.engine.pathtracing.stage.base import Transformed

SPHERE_DIVISIONS = 5
CLOSED_TOLERANCE = 1e-6
"""Share of the area of a closed solid that is left where the areas of its faces are added as vectors."""
_MOST_DIRECT_COSINE = -0.5
"""Cosine of the largest angle that an axis is turned to up the shortest way; no up that is nearly one of the
axes is nearly this."""
MAX_SOLIDS = 2000
"""So many solids of one mesh, the largest ones, are looked at for what lies within others."""


def primitive_shape(name: str) -> MeshShape:
    """Return a ``sphere`` of radius 1, a ``cube`` from -1 to 1, or a ``plane`` from -1 to 1 with normal y."""
    return {"sphere": _sphere_shape, "cube": _cube_shape, "plane": _plane_shape}[name]()


def rotation_matrix(degrees: tuple[float, float, float]) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation about the fixed axes x, then y, then z."""
    matrix = np.eye(3)
    for axis, angle in enumerate(np.radians(degrees)):
        turn = np.eye(3)
        a, b = (axis + 1) % 3, (axis + 2) % 3
        turn[a, a] = turn[b, b] = np.cos(angle)
        turn[b, a], turn[a, b] = np.sin(angle), -np.sin(angle)
        matrix = turn @ matrix
    return matrix


def align_axis_to_up(axis: str, up_world: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "3 3"]:
    """Return a rotation of an axis (``y``, ``-z``, ...) to up; the identity for ``world``.

    The shortest one, but where that is more than :data:`_MOST_DIRECT_COSINE` says: then it begins with a half
    turn about x, or about y where the axis is x. glTF's y to COLMAP's -y is the half turn about x that the
    project's own GLB files are written with, and an up that differs a little from that turns a mesh a little
    only. The shortest rotation there would turn it by any angle about up.
    """
    if axis == "world":
        return np.eye(3)
    place = "xyz".index(axis[-1])
    start = np.eye(3)[place] * (-1.0 if axis.startswith("-") else 1.0)
    end = up_world / np.linalg.norm(up_world)
    cosine = float(start @ end)
    if cosine < _MOST_DIRECT_COSINE:
        half_turn = np.diag([-1.0, 1.0, -1.0]) if place == 0 else np.diag([1.0, -1.0, -1.0])
        return _shortest_rotation(-start, end) @ half_turn
    return _shortest_rotation(start, end)


def _shortest_rotation(
    start: Float64[np.ndarray, "3"], end: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3 3"]:
    """Return the shortest rotation from one unit vector to another, which is not its opposite."""
    v = np.cross(start, end)
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + start @ end))


def up_axis_rotation(
    axis: str, degrees: float, up_world: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3 3"]:
    """Return :func:`align_axis_to_up` followed by a rotation about up, anticlockwise seen from above."""
    aligned = align_axis_to_up(axis, up_world)
    if degrees == 0:
        return aligned
    from scipy.spatial.transform import Rotation  # here, as most meshes are not turned

    up = up_world / np.linalg.norm(up_world)
    return np.asarray(Rotation.from_rotvec(np.radians(degrees) * up).as_matrix() @ aligned)


def transform_points(
    points: Float64[np.ndarray, "n 3"],
    placement: Transformed,
    rotation: Float64[np.ndarray, "3 3"] | None = None,
) -> Float64[np.ndarray, "n 3"]:
    """Return points scaled along their own axes, rotated, and translated to the world."""
    linear_map = rotation_matrix(placement.rotation_degrees) @ (np.eye(3) if rotation is None else rotation)
    return points * np.array(placement.scale) @ linear_map.T + np.array(placement.position)


def transform_normals(
    normals: Float64[np.ndarray, "*n 3"], placement: Transformed, rotation: Float64[np.ndarray, "3 3"]
) -> Float32[np.ndarray, "*n 3"]:
    """Return unit normals of points transformed by :func:`transform_points`; NaN for those of no length."""
    # normals scale by the inverse
    turned = normals / np.array(placement.scale) @ (rotation_matrix(placement.rotation_degrees) @ rotation).T
    lengths = np.linalg.norm(turned, axis=-1, keepdims=True)
    return np.asarray((turned / np.where(lengths > 1e-12, lengths, np.nan)).astype(np.float32))


def corner_normals(
    corners_world: Float[np.ndarray, "f 3 3"], smooth_degrees: float
) -> Float32[np.ndarray, "f 3 3"]:
    """Return normals at face corners, averaged across edges of less than an angle."""
    points = corners_world.reshape(-1, 3).astype(np.float64)
    size = max(float(np.ptp(points, axis=0).max(initial=0.0)), 1e-30)
    _, owner = np.unique(
        np.round(points / (WELD_TOLERANCE * size)).astype(np.int64), axis=0, return_inverse=True
    )
    order = np.argsort(owner.reshape(-1), kind="stable")
    counts = np.bincount(owner.reshape(-1))
    starts = np.concatenate([[0], np.cumsum(counts)])
    normals = np.empty(corners_world.shape, np.float32)
    # below any cosine: all faces at a point
    least = -2.0 if smooth_degrees >= 180 else np.cos(np.radians(smooth_degrees)) - 1e-9
    smooth_normals(corners_world.astype(np.float64), order, starts, least, normals)
    return normals


def turn_outwards(shape: MeshShape, face_mask: Bool[np.ndarray, " f"]) -> MeshShape | None:
    """Return a shape with closed faces that face inwards turned over; None where none do.

    Args:
        shape: the triangles.
        face_mask: the faces, which close one or more solids. A solid faces inwards where its volume is
            negative; what lies within another, such as a bubble, is turned with that alone.
    """
    face_mask = face_mask & _faces_inwards(shape, face_mask)
    if not face_mask.any():
        return None
    faces = shape.faces[face_mask]
    a, b, c = shape.vertices[faces[:, 0]], shape.vertices[faces[:, 1]], shape.vertices[faces[:, 2]]

    def turned(corners: np.ndarray | None) -> np.ndarray | None:
        if corners is None:
            return None
        found = corners.copy()
        found[face_mask] = corners[face_mask][:, [0, 2, 1]]
        return found

    normals = turned(shape.corner_normals)
    if normals is not None:
        outwards = np.cross(c - a, b - a)
        # normals may face outwards already, whatever the winding
        if np.nansum(normals[face_mask] * outwards[:, None]) < 0:
            normals[face_mask] = -normals[face_mask]
    turned_faces = turned(shape.faces)
    assert turned_faces is not None
    return replace(
        shape,
        faces=turned_faces,
        corner_uv=turned(shape.corner_uv),
        corner_normals=normals,
        corner_rgb_linear=turned(shape.corner_rgb_linear),
        corner_alpha=turned(shape.corner_alpha),
    )


def _faces_inwards(shape: MeshShape, face_mask: Bool[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
    """Return the faces of solids that face inwards, or that lie within such a one."""
    from scipy.sparse import coo_array  # here, as most meshes are no solids of glass
    from scipy.sparse.csgraph import connected_components

    faces = shape.faces[face_mask]
    owner = weld_vertices(shape.vertices)
    edges = owner[faces[:, [0, 1, 1, 2]]].reshape(-1, 2).T
    count = int(owner.max()) + 1
    links = coo_array((np.ones(edges.shape[1], bool), (edges[0], edges[1])), (count, count))
    _, solids = np.unique(
        connected_components(links, directed=False)[1][owner[faces[:, 0]]], return_inverse=True
    )
    solids = solids.reshape(-1)
    total = int(solids.max(initial=-1)) + 1
    # far from the origin the sum of volumes would lose its digits
    points = shape.vertices - shape.vertices.mean(axis=0)
    corners = points[faces]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    volumes = np.bincount(solids, np.einsum("fk,fk->f", corners[:, 0], areas), total)
    inwards = volumes < 0
    if total > 1:
        # the areas of what is closed cancel; what is not has no inside
        left = np.stack([np.bincount(solids, areas[:, axis], total) for axis in range(3)], axis=1)
        whole = np.bincount(solids, np.linalg.norm(areas, axis=1), total)
        inwards &= np.linalg.norm(left, axis=1) < CLOSED_TOLERANCE * whole
        low, high = np.full((total, 3), np.inf), np.full((total, 3), -np.inf)
        np.minimum.at(low, solids, corners.min(axis=1))
        np.maximum.at(high, solids, corners.max(axis=1))
        # the largest first, so that what a solid lies within is known before it
        order = np.argsort(-(high - low).prod(axis=1), kind="stable")
        for place, solid in enumerate(order[:MAX_SOLIDS]):
            larger = order[:place]
            around = larger[((low[larger] < low[solid]) & (high[solid] < high[larger])).all(axis=1)]
            if len(around):
                inwards[solid] = inwards[around[0]]
    found = np.zeros(len(shape.faces), bool)
    found[face_mask] = inwards[solids]
    return found


def _sphere_shape() -> MeshShape:
    """Return an icosahedron subdivided several times and projected to the unit sphere."""
    golden = (1 + 5**0.5) / 2
    around = np.array([[-1, golden, 0], [1, golden, 0], [-1, -golden, 0], [1, -golden, 0]])
    vertices = np.concatenate([around, np.roll(around, 1, axis=1), np.roll(around, 2, axis=1)])
    faces = np.array(
        [[0, 11, 5], [0, 5, 1], [0, 1, 7], [0, 7, 10], [0, 10, 11], [1, 5, 9], [5, 11, 4], [11, 10, 2],
         [10, 7, 6], [7, 1, 8], [3, 9, 4], [3, 4, 2], [3, 2, 6], [3, 6, 8], [3, 8, 9], [4, 9, 5], [2, 4, 11],
         [6, 2, 10], [8, 6, 7], [9, 8, 1]]
    )  # fmt: skip
    for _ in range(SPHERE_DIVISIONS):
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        unique, place = np.unique(edges, axis=0, return_inverse=True)
        middle = place.reshape(-1, 3) + len(vertices)
        vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
        a, b, c = faces.T
        ab, bc, ca = middle.T
        faces = np.concatenate(
            [np.stack(t, axis=1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))]
        )
    vertices = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    corners = vertices[faces]
    u = 0.5 + np.arctan2(corners[..., 0], corners[..., 2]) / (2 * np.pi)
    # a pole has no longitude: the middle of the face's other two
    u = np.where(np.hypot(corners[..., 0], corners[..., 2]) < 1e-9, np.nan, u)
    u = np.where(np.nanmax(u, axis=1, keepdims=True) - u > 0.5, u + 1, u)  # faces across the seam
    u = np.where(np.isnan(u), np.nanmean(u, axis=1, keepdims=True), u)
    uv = np.stack([u, np.arccos(np.clip(corners[..., 1], -1, 1)) / np.pi], axis=-1)
    return MeshShape(vertices, faces.astype(np.int64), uv.astype(np.float32), corners)


def _cube_shape() -> MeshShape:
    """Return a cube; images stand upright on its sides, and their tops are at -z above and at z below."""
    vertices: list[Float64[np.ndarray, 3]] = []
    faces: list[list[int]] = []
    uv: list[list[list[int]]] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            n = np.eye(3)[axis] * sign
            # to the right and up in the image, as seen from outside
            u = np.eye(3)[0] if axis == 1 else np.cross([0, 1, 0], n)
            w = np.cross(n, u)
            first = len(vertices)
            vertices += [n - u - w, n + u - w, n + u + w, n - u + w]
            faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
            square = [[0, 1], [1, 1], [1, 0], [0, 0]]
            uv += [[square[0], square[1], square[2]], [square[0], square[2], square[3]]]
    return MeshShape(np.array(vertices), np.array(faces, np.int64), np.array(uv, np.float32))


def _plane_shape() -> MeshShape:
    vertices = np.array([[-1.0, 0, 1], [1, 0, 1], [1, 0, -1], [-1, 0, -1]])
    uv = np.array([[[0, 1], [1, 1], [1, 0]], [[0, 1], [1, 0], [0, 0]]], np.float32)
    return MeshShape(vertices, np.array([[0, 1, 2], [0, 2, 3]], np.int64), uv)
