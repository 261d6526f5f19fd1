"""Polygons cut into triangles: fans where they are convex, ears where they are not."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, Int64

MAX_CORNERS = 500
"""Of polygons that are looked at corner by corner, which takes time that grows with their square."""
_TOLERANCE = 1e-9
"""Share of a polygon's area that a triangle may be turned over by rounding."""


def fan_places(sides: int) -> Int64[np.ndarray, "t 3"]:
    """Return the corners of the triangles of a fan.

    >>> fan_places(4).tolist()
    [[0, 1, 2], [0, 2, 3]]
    """
    return np.array([[0, k, k + 1] for k in range(1, sides - 1)], np.int64).reshape(-1, 3)


def triangle_places(corners: Float64[np.ndarray, "p c 3"]) -> Int64[np.ndarray, "p t 3"]:
    """Return the corners of the triangles into which polygons of equally many corners are cut.

    Args:
        corners: of flat polygons, or nearly so, which do not cross themselves.

    >>> arrow = np.array([[[0, 0, 0], [1, 1, 0], [0, 0.5, 0], [-1, 1, 0]]], float)
    >>> triangle_places(arrow).tolist(), triangle_places(arrow[:, [1, 2, 3, 0]]).tolist()
    ([[[0, 1, 2], [0, 2, 3]]], [[[3, 0, 1], [1, 2, 3]]])
    """
    count, sides = corners.shape[:2]
    fan = fan_places(sides)
    places = np.broadcast_to(fan, (count, *fan.shape)).copy()
    if sides < 4:
        return places
    first = corners - corners[:, :1]
    across = np.cross(first[:, 1:-1], first[:, 2:])
    normals = across.sum(axis=1)
    along = np.einsum("ptk,pk->pt", across, normals)
    # a triangle of the fan that lies outside is turned over
    is_concave = (along < -_TOLERANCE * (normals**2).sum(axis=1)[:, None]).any(axis=1)
    if sides <= MAX_CORNERS:
        for k in np.flatnonzero(is_concave):
            places[k] = _ears(corners[k], normals[k])
    return places


def _ears(corners: Float64[np.ndarray, "c 3"], normal: Float64[np.ndarray, "3"]) -> Int64[np.ndarray, "t 3"]:
    """Cut off one corner after the other that is convex and that no other corner lies in."""
    axis = int(np.abs(normal).argmax())
    # seen along the axis, anticlockwise
    flat = np.delete(corners, axis, axis=1) * [1.0, (-1.0 if axis == 1 else 1.0) * np.sign(normal[axis])]
    left = list(range(len(corners)))
    found: list[list[int]] = []
    while len(left) > 3:
        place = next((k for k in range(len(left)) if _is_ear(flat, left, k)), 0)
        found.append([left[place - 1], left[place], left[(place + 1) % len(left)]])
        del left[place]
    return np.array([*found, left], np.int64)


def _is_ear(flat: Float64[np.ndarray, "c 2"], left: Sequence[int], k: int) -> bool:
    a, b, c = flat[left[k - 1]], flat[left[k]], flat[left[(k + 1) % len(left)]]
    if not _turn(a, b, c) > 0.0:
        return False
    others = flat[left]
    others = others[~np.any([(others == corner).all(axis=1) for corner in (a, b, c)], axis=0)]
    inside = (_turn(a, b, others) >= 0.0) & (_turn(b, c, others) >= 0.0) & (_turn(c, a, others) >= 0.0)
    return not inside.any()


def _turn(
    a: Float64[np.ndarray, "2"], b: Float64[np.ndarray, "2"], c: Float64[np.ndarray, "*n 2"]
) -> Float64[np.ndarray, "*n"]:
    """Return twice the area of triangles, positive where they run anticlockwise."""
    return np.asarray((b[0] - a[0]) * (c[..., 1] - a[1]) - (b[1] - a[1]) * (c[..., 0] - a[0]))
