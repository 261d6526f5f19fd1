"""Local origin for scenes whose coordinates are large compared with their size, such as map coordinates.

Gaussians, rays and most files hold 32-bit numbers, whose steps at five million metres are half a metre. Such
scenes are stored relative to a local origin, which is kept in 64 bits beside them: a user gives and reads the
sum of both. Scenes near the origin of their coordinates have the local origin zero.
"""

import itertools

import numpy as np
from jaxtyping import Float, Float64

Origin = tuple[float, float, float]
Box = tuple[float, float, float, float, float, float]
NO_ORIGIN: Origin = (0.0, 0.0, 0.0)
MAX_DISTANCE = 100.0
"""A centre farther than so many extents asks for a local origin: 32 bits leave 1e-5 of the extent there."""
MAX_STEP = 0.01
"""Gaussians in one place ask for a local origin where 32 bits leave more than this share of their size."""


def choose_origin(centre: Float[np.ndarray, "3"], extent: float) -> Origin:
    """Return the local origin of a scene, zeros where its coordinates are not large.

    The origin is a round number near the centre, so that it can be copied by hand.

    Args:
        centre: of the scene.
        extent: its radius.

    >>> choose_origin(np.array([512345.6, 5403210.9, 310.2]), 24.0)
    (512350.0, 5403210.0, 310.0)
    >>> choose_origin(np.array([20.0, 3.0, 1.0]), 24.0)
    (0.0, 0.0, 0.0)
    """
    if not (np.isfinite(centre).all() and extent > 0 and np.linalg.norm(centre) > MAX_DISTANCE * extent):
        return NO_ORIGIN
    # A power of ten no larger than the extent: rounding moves the origin by at most half an extent an axis.
    step = 10.0 ** np.floor(np.log10(extent))
    x, y, z = (np.rint(np.asarray(centre, np.float64) / step) * step).tolist()
    return (x, y, z)


def choose_origin_of_place(place: Float[np.ndarray, "3"], size: float) -> Origin:
    """Return the local origin of Gaussians that are all in one place, zeros where 32 bits do for it.

    Args:
        place: where they are.
        size: of one of them; 0 where it is not known.

    >>> choose_origin_of_place(np.array([512345.6, 5403210.9, 310.2]), 2.0)
    (512346.0, 5403211.0, 310.0)
    >>> choose_origin_of_place(np.array([20.0, 3.0, 1.0]), 2.0)
    (0.0, 0.0, 0.0)
    """
    if not np.isfinite(place).all():
        return NO_ORIGIN
    step = float(np.spacing(np.float32(np.abs(place).max())))
    return choose_origin(place, size) if step > MAX_STEP * size else NO_ORIGIN


def is_set(origin: Origin) -> bool:
    """Return whether there is a local origin.

    >>> is_set((0.0, 0.0, 0.0)), is_set((512350.0, 5403210.0, 310.0))
    (False, True)
    """
    return any(value != 0.0 for value in origin)


def describe_origin(origin: Origin) -> str:
    """Return the coordinates of an origin in text, every digit.

    >>> describe_origin((512350.0, 5403210.0, 310.0))
    '512350 5403210 310'
    """
    return " ".join(f"{value:.15g}" for value in origin)


def box_about(box: Box | None, origin: Origin) -> Box | None:
    """Return a box in the coordinates of the user, low and high corner in one, about an origin."""
    if box is None:
        return None
    x0, y0, z0, x1, y1, z1 = (float(value) for value in np.array(box) - np.tile(origin, 2))
    return (x0, y0, z0, x1, y1, z1)


def user_position(position: Float[np.ndarray, "3"], origin: Origin) -> str:
    """Return a position relative to ``origin`` as text in the coordinates of the user."""
    if not is_set(origin):
        return " ".join(f"{value:.4g}" for value in position)
    return " ".join(f"{value + start:.11g}" for value, start in zip(position.tolist(), origin, strict=True))


def vertices_about(
    vertices: Float64[np.ndarray, "v 3"], origin: Origin, *, has_same_axes: bool = False
) -> Float64[np.ndarray, "v 3"]:
    """Return vertices of a file relative to a local origin, whichever of the two frames the file uses.

    Programs either apply the transform of a file's root node or leave it out, and may turn axes. As the
    origin is far from the scene, the vertices themselves show which is the case.

    Args:
        vertices: as a file gives them.
        origin: of the scene that they belong to.
        has_same_axes: whether they are along the axes of the scene; else they are along whatever axes.
    """
    if not is_set(origin) or len(vertices) == 0:
        return vertices
    centre = np.median(vertices, axis=0)
    start = np.array(origin) if has_same_axes else _turned_origin(vertices, centre, origin)
    is_far = np.linalg.norm(centre - start) < np.linalg.norm(centre) / 2
    return vertices - start if is_far else vertices


def _turned_origin(
    vertices: Float64[np.ndarray, "v 3"], centre: Float64[np.ndarray, "3"], origin: Origin
) -> Float64[np.ndarray, "3"]:
    """Return the origin along the axes of vertices, as near to their centre as it can be.

    Files differ in what is up, and a few in handedness, too: what mirrors counts only where it is clearly
    nearer, as heights are small beside map coordinates, and what lies below the sea is not mirrored.
    """
    nearest: dict[bool, tuple[float, np.ndarray]] = {}
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            mirrors = bool(np.linalg.det(np.diag(signs)[:, list(order)]) < 0)
            turned = np.array(signs) * np.array(origin)[list(order)]
            distance = float(np.linalg.norm(centre - turned))
            if mirrors not in nearest or distance < nearest[mirrors][0]:
                nearest[mirrors] = distance, turned
    size = float(np.median(np.linalg.norm(vertices - centre, axis=1)))
    mirrors = 2.0 * nearest[True][0] + size < nearest[False][0]
    return nearest[mirrors][1]


def local_map(
    matrix: Float[np.ndarray, "4 4"], origin: Origin, new_origin: Origin
) -> Float64[np.ndarray, "4 4"]:
    """Return an affine map of user coordinates as a map between points relative to two local origins."""
    local = np.array(matrix, np.float64)
    # x' + new_origin = A (x + origin) + t
    local[:3, 3] += local[:3, :3] @ np.array(origin) - np.array(new_origin)
    return local


def origin_after(
    matrix: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"], origin: Origin, size: float = 0.0
) -> Origin:
    """Return the local origin of points after an affine map of user coordinates.

    Args:
        matrix: the map.
        points: about ``origin``.
        origin: the local origin before.
        size: of what is at a point, after the map; 0 where it is not known.
    """
    linear = np.asarray(matrix, np.float64)[:3, :3]
    carried = linear @ np.array(origin) + matrix[:3, 3]  # where the map takes the old local origin
    moved = np.asarray(points, np.float64) @ linear.T
    centre = np.median(moved, axis=0)
    extent = float(np.median(np.linalg.norm(moved - centre, axis=1)))
    chosen = choose_origin(centre + carried, extent)
    if extent == 0.0:  # of points in one place only their size says whether their coordinates are large
        chosen = choose_origin_of_place(centre + carried, size)
        was_far = is_set(origin) and np.linalg.norm(carried) > MAX_DISTANCE * np.linalg.norm(centre)
        is_far = was_far and (size == 0.0 or is_set(chosen))
    else:
        is_far = is_set(chosen) and is_set(origin) and np.linalg.norm(centre) <= MAX_DISTANCE * extent
    if is_far:
        x, y, z = carried.tolist()
        return (x, y, z)  # points keep their local coordinates
    return chosen
