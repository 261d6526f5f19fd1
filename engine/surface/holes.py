"""Holes in a mesh: their boundary loops, and triangles that close them."""

import heapq

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from octasplat.engine.geometry.triangle_mesh import TriangleMesh, directed_edges

BoundaryLoop = list[int]


def boundary_loops(faces: Int32[np.ndarray, "m 3"]) -> list[BoundaryLoop]:
    """Return the closed boundary loops of a mesh, in the winding of triangles that would close them.

    A rim that passes a vertex twice is cut there into simple ones.
    """
    edges = directed_edges(faces).astype(np.int64)
    if len(edges) == 0:
        return []
    size = int(faces.max()) + 1
    # one number an edge: exact in int64
    keys, back = edges[:, 0] * size + edges[:, 1], edges[:, 1] * size + edges[:, 0]
    open_edges = edges[~np.isin(keys, back)]
    after: dict[int, list[int]] = {}
    for start, end in open_edges[:, ::-1].tolist():  # the hole lies on the other side
        after.setdefault(start, []).append(end)
    found: list[BoundaryLoop] = []
    while after:
        path = [next(iter(after))]
        place = {path[0]: 0}
        while True:
            following = after.get(path[-1])
            if not following:
                break  # not closed, which only a mesh with twisted edges has
            vertex = following.pop()
            if not following:
                del after[path[-1]]
            if vertex in place:
                loop = path[place[vertex] :]
                found.append(loop)
                # what lies on the loop may be visited again by another one
                for passed in loop[1:]:
                    del place[passed]
                del path[place[vertex] + 1 :]
                if len(path) == 1 and path[0] not in after:
                    break
            else:
                place[vertex] = len(path)
                path.append(vertex)
    return [loop for loop in found if len(loop) >= 3]


def fill_holes(mesh: TriangleMesh, max_rim: float | None) -> tuple[TriangleMesh, int]:
    """Close the holes whose rim is no longer than ``max_rim`` (world units; None closes all).

    A hole is closed by cutting off its sharpest corner again and again; where that would draw an edge or a
    triangle that the mesh has already, by a fan around a new vertex in its middle. The winding is that of the
    mesh around it. To be done before colors are baked.

    Returns:
        The mesh, and the number of holes closed.
    """
    points = mesh.vertices_world.astype(np.float64)
    edges = np.sort(directed_edges(mesh.faces).astype(np.int64), axis=1)
    count = len(points)
    keys = edges[:, 0] * count + edges[:, 1]
    taken = set(keys.tolist())
    lonely = _isolated_faces(mesh.faces, keys)
    new_points: list[Float64[np.ndarray, 3]] = []
    new_faces: list[tuple[int, int, int]] = []
    closed = 0
    for rim in boundary_loops(mesh.faces):
        corners = points[rim]
        # length of the rim
        length = float(np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1).sum())
        if max_rim is not None and length > max_rim:
            continue
        closed += 1
        patch = None if frozenset(rim) in lonely else _ear_clip(rim, points, taken, count)
        if patch is None:
            middle = count + len(new_points)
            new_points.append(corners.mean(axis=0))
            patch = [(a, b, middle) for a, b in zip(rim, rim[1:] + rim[:1], strict=True)]
        new_faces += patch
    if not closed:
        return mesh, 0
    added: Float32[np.ndarray, "k 3"] = np.array(new_points, np.float32).reshape(-1, 3)
    faces = np.concatenate([mesh.faces, np.array(new_faces, np.int32).reshape(-1, 3)])
    return TriangleMesh(np.concatenate([mesh.vertices_world, added]), faces), closed


def _isolated_faces(
    faces: Int32[np.ndarray, "m 3"], edge_keys: Int64[np.ndarray, " e"]
) -> set[frozenset[int]]:
    """Return the corners of triangles without neighbours, whose boundary is their own."""
    _, place, uses = np.unique(edge_keys, return_inverse=True, return_counts=True)
    alone = (uses[place.reshape(-1)] == 1).reshape(-1, 3).all(axis=1)
    return {frozenset(face) for face in faces[alone].tolist()}


def _ear_clip(
    rim: BoundaryLoop, points: Float64[np.ndarray, "n 3"], taken: set[int], count: int
) -> list[tuple[int, int, int]] | None:
    """Return triangles that close a loop, or None if they would need an existing edge.

    The edges drawn are added to ``taken``.
    """
    size = len(rim)
    before, after = [(k - 1) % size for k in range(size)], [(k + 1) % size for k in range(size)]
    version = [0] * size
    queue: list[tuple[float, int, int]] = []

    def key(a: int, b: int) -> int:
        return min(a, b) * count + max(a, b)

    def push(k: int) -> None:
        one, two = points[rim[before[k]]] - points[rim[k]], points[rim[after[k]]] - points[rim[k]]
        lengths = float(np.linalg.norm(one) * np.linalg.norm(two))
        # larger cosine, sharper corner: first out of the heap
        cosine = float(one @ two) / lengths if lengths > 0 else 1.0
        version[k] += 1
        heapq.heappush(queue, (-cosine, k, version[k]))

    for k in range(size):
        push(k)
    patch: list[tuple[int, int, int]] = []
    drawn: set[int] = set()
    left = size
    while left > 3:
        while queue:
            _, k, made = heapq.heappop(queue)
            if made != version[k]:  # an entry of before its corner's neighbors changed
                continue
            line = key(rim[before[k]], rim[after[k]])
            if line not in taken and line not in drawn:
                break
        else:
            return None  # only edges that exist already are left
        drawn.add(line)
        patch.append((rim[before[k]], rim[k], rim[after[k]]))
        after[before[k]], before[after[k]] = after[k], before[k]
        version[k] = -1
        left -= 1
        push(before[k])
        push(after[k])
    k = next(k for k in range(size) if version[k] >= 0)
    patch.append((rim[before[k]], rim[k], rim[after[k]]))
    taken |= drawn
    return patch
