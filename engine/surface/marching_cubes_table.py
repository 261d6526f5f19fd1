"""The case table of marching cubes, computed from the cell's geometry.

Corner c of a cell lies at (c & 1, c >> 1 & 1, c >> 2 & 1); edge 4 a + k runs along axis a. A case is the set
of corners inside the surface. On each face of the cell the surface cuts off every run of inside corners by
one line; the lines join to closed loops, which are cut into triangles. Two cells see the same corners on
their common face and hence the same lines, so the whole is closed and every edge has two triangles. Where
two inside corners lie diagonally on a face they are kept apart.
"""

from functools import cache

import numpy as np
from jaxtyping import Int8, Int32

_Loop = tuple[int, ...]
_Triangles = list[tuple[int, int, int]]


def _cell_edges() -> tuple[tuple[int, int], ...]:
    """Return the two corners of each edge, the lower first."""
    found = []
    for axis in range(3):
        found += [(c, c | 1 << axis) for c in range(8) if not c >> axis & 1]
    return tuple(found)


EDGES = _cell_edges()
"""Corners of the twelve edges."""


def _cell_faces() -> tuple[tuple[int, ...], ...]:
    """Return the four corners of each face, anticlockwise as seen from outside the cell."""
    found: list[tuple[int, ...]] = []
    for axis in range(3):
        first, second = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        ring = (0, first, first | second, second)
        found.append(tuple(corner | 1 << axis for corner in ring))
        found.append(tuple(reversed(ring)))
    return tuple(found)


FACES = _cell_faces()


def _faces_of_edges() -> tuple[frozenset[int], ...]:
    return tuple(
        frozenset(number for number, face in enumerate(FACES) if set(edge) <= set(face)) for edge in EDGES
    )


_FACES_OF_EDGES = _faces_of_edges()


def case_loops(case: int) -> list[_Loop]:
    """Return the closed loops of crossed edges of a case, anticlockwise as seen from outside."""
    number = {frozenset(edge): k for k, edge in enumerate(EDGES)}
    after: dict[int, int] = {}
    for face in FACES:
        inside = [bool(case >> corner & 1) for corner in face]
        for k in range(4):
            if inside[k] and not inside[(k + 1) % 4]:
                outgoing = number[frozenset((face[k], face[(k + 1) % 4]))]
                start = k
                while inside[start - 1]:  # back to where this run of inside corners was entered
                    start -= 1
                entering = number[frozenset((face[start - 1], face[start % 4]))]
                after[entering] = outgoing
    found = []
    while after:
        first, current = next(iter(after.items()))
        loop = [first]
        del after[first]
        while current != first:
            loop.append(current)
            current = after.pop(current)
        found.append(tuple(loop))
    return found


def _loop_triangulations(loop: _Loop) -> list[_Triangles]:
    if len(loop) < 3:
        return [[]]
    found = []
    for k in range(1, len(loop) - 1):
        here = (loop[0], loop[k], loop[-1])
        for left in _loop_triangulations(loop[: k + 1]):
            found += [[here, *left, *right] for right in _loop_triangulations(loop[k:])]
    return found


def case_triangles(case: int) -> _Triangles:
    """Return the triangles of a case as triples of edges.

    No diagonal joins two edges of one face: the neighbouring cell could draw the same one.
    """
    found: _Triangles = []
    for loop in case_loops(case):
        sides = {frozenset((a, b)) for a, b in zip(loop, (*loop[1:], loop[0]), strict=True)}
        for candidate in _loop_triangulations(loop):  # the first that no neighbor can contradict
            lines = {frozenset(pair) for a, b, c in candidate for pair in ((a, b), (b, c), (c, a))}
            if all(not _share_a_face(*line) for line in lines - sides):
                found += candidate
                break
        else:
            raise AssertionError(f"case {case} has no triangulation")
    return found


def _share_a_face(first: int, second: int) -> bool:
    return bool(_FACES_OF_EDGES[first] & _FACES_OF_EDGES[second])


@cache
def marching_table() -> tuple[Int8[np.ndarray, "256 t"], Int32[np.ndarray, " 256"]]:
    """Return the edges of each case's triangles in sequence, and each case's number of triangles."""
    every = [case_triangles(case) for case in range(256)]
    counts = np.array([len(found) for found in every], np.int32)
    table = np.full((256, 3 * int(counts.max())), -1, np.int8)
    for case, found in enumerate(every):
        table[case, : 3 * len(found)] = np.array(found, np.int8).reshape(-1)
    return table, counts
