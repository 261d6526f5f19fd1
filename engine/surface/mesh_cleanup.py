"""Removal of small components, and decimation."""

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from octasplat.engine.geometry.triangle_mesh import TriangleMesh, directed_edges, edge_report
from octasplat.engine.surface.holes import fill_holes

MANIFOLD_ROUNDS = 5


def face_components(mesh: TriangleMesh) -> Int32[np.ndarray, " m"]:
    """Return the connected component of each triangle.

    Parts hang together at edges: where two only touch at a vertex, they are two.
    """
    count = len(mesh.faces)
    edges = np.sort(directed_edges(mesh.faces).astype(np.int64), axis=1)
    keys = edges[:, 0] * (int(mesh.faces.max(initial=0)) + 1) + edges[:, 1]
    order = np.argsort(keys, kind="stable")
    same = keys[order[1:]] == keys[order[:-1]]
    one, two = order[1:][same] // 3, order[:-1][same] // 3
    graph = coo_matrix((np.ones(len(one), np.uint8), (one, two)), shape=(count, count))
    _, part = connected_components(graph, directed=False)
    return part.astype(np.int32)


def keep_largest_components(
    mesh: TriangleMesh, *, keep: int | None = None, min_share: float = 0.0
) -> TriangleMesh:
    """Return the ``keep`` largest components by area, without those below ``min_share`` of the largest."""
    part = face_components(mesh)
    areas: Float64[np.ndarray, " p"] = np.bincount(part, mesh.face_areas)
    if keep is not None:
        is_retained = np.zeros(len(areas), dtype=bool)
        is_retained[np.argsort(-areas, kind="stable")[:keep]] = True
    else:
        is_retained = areas >= min_share * areas.max()
    return mesh.select_faces(is_retained[part])


def decimate(mesh: TriangleMesh, max_triangles: int) -> TriangleMesh:
    """Return a mesh of at most ``max_triangles`` triangles, by quadric edge collapse.

    Colors are not carried over; bake them afterwards. A watertight mesh stays watertight. Closing what the
    collapse tangled can add a handful of triangles back, so that a few more than asked for may come out.
    """
    import fast_simplification

    if len(mesh.faces) <= max_triangles:
        return mesh
    # The library stops short of its aim now and then; a few more rounds bring it there.
    points, faces = mesh.vertices_world, mesh.faces
    for aggression in (5, 7, 10):
        points, faces = fast_simplification.simplify(
            points, faces, target_count=max_triangles, agg=aggression
        )
        if len(faces) <= max_triangles:
            break
    points, faces = np.ascontiguousarray(points, np.float32), np.ascontiguousarray(faces, np.int32)
    return _make_manifold(TriangleMesh(points, faces), closed=edge_report(mesh.faces).is_watertight)


def _make_manifold(mesh: TriangleMesh, *, closed: bool) -> TriangleMesh:
    """Return the mesh without triangles at non-manifold edges; the resulting holes are closed again.

    Collapsing edges now and then folds a thin part onto itself, down to two triangles back to back.
    """
    for _ in range(MANIFOLD_ROUNDS):
        mesh = mesh.select_faces(_is_manifold_face(mesh.faces))
        if closed:
            mesh, _ = fill_holes(mesh, None)
        if _is_manifold_face(mesh.faces).all():
            break
    return mesh


def _is_manifold_face(faces: Int32[np.ndarray, "m 3"]) -> Bool[np.ndarray, " m"]:
    """Return which triangles have three distinct corners and edges that no other winds alike."""
    edges = directed_edges(faces).astype(np.int64)
    size = int(faces.max(initial=0)) + 1
    # An edge used twice in one direction is crowded or twisted.
    alone = _is_unique(edges[:, 0] * size + edges[:, 1]).reshape(-1, 3).all(axis=1)
    low, middle, high = np.sort(faces.astype(np.int64), axis=1).T
    distinct = (low < middle) & (middle < high)
    _, pair = np.unique(low * size + middle, return_inverse=True)  # exact keys of three corners, by pairs
    result: np.ndarray = alone & distinct & _is_unique(pair.reshape(-1) * size + high)
    return result


def _is_unique(keys: Int64[np.ndarray, " k"]) -> Bool[np.ndarray, " k"]:
    """Return which keys occur once."""
    _, place, uses = np.unique(keys, return_inverse=True, return_counts=True)
    return np.asarray(uses[place.reshape(-1)] == 1)
