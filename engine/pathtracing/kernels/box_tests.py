"""Tests of rays and boxes: which pixels have paths that may meet Gaussians.

All rays of a block are tested against the box around everything first. Where none enters it, that is all.
The others are tested against all boxes at once, without a branch, so that the compiler makes vectors of it.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int32

from octasplat.engine.pathtracing.kernels.path_args import PATH_ENDED, Bounce
from octasplat.engine.trace.kernels.native import njit_no_refcount

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_LEAST_SLOPE = np.float32(1e-20)
"""Rays along a box's side count as this steep, so that nothing is divided by zero."""
_NEARER, _FARTHER = np.float32(1.0 - 1e-6), np.float32(1.0 + 1e-6)
"""More than float32 rounds off distances along rays."""


class _Ray(NamedTuple):
    """A ray: its origin, and one over its direction."""

    x: np.float32
    y: np.float32
    z: np.float32
    per_x: np.float32
    per_y: np.float32
    per_z: np.float32


class _Box(NamedTuple):
    """A box's least corner, and its greatest."""

    low_x: np.float32
    low_y: np.float32
    low_z: np.float32
    high_x: np.float32
    high_y: np.float32
    high_z: np.float32


@njit_no_refcount(forceinline=True)
def _inverse(slope: np.float32) -> np.float32:
    """Return one over a slope."""
    return _ONE / (slope if slope > _LEAST_SLOPE or slope < -_LEAST_SLOPE else _LEAST_SLOPE)


@njit_no_refcount(forceinline=True)
def make_ray(origin: Float32[np.ndarray, "3"], direction: Float32[np.ndarray, "3"]) -> _Ray:
    """Return a ray as the tests want it."""
    return _Ray(
        origin[0], origin[1], origin[2],
        _inverse(direction[0]), _inverse(direction[1]), _inverse(direction[2]),
    )  # fmt: skip


@njit_no_refcount(forceinline=True)
def _clip(
    low: np.float32,
    high: np.float32,
    origin: np.float32,
    per_slope: np.float32,
    stretch: tuple[np.float32, np.float32],
) -> tuple[np.float32, np.float32]:
    """Return the part of a stretch of a ray that lies between two planes across an axis."""
    a, b = (low - origin) * per_slope, (high - origin) * per_slope
    # ternaries: min and max ask for NaN, too
    first, last = (a, b) if a < b else (b, a)
    near, far = stretch
    return first if first > near else near, last if last < far else far


@njit_no_refcount(forceinline=True)
def _enters(ray: _Ray, box: _Box, t_max: np.float32) -> bool:
    """Return whether a ray enters a box before ``t_max``, or begins in it."""
    stretch = _clip(box.low_x, box.high_x, ray.x, ray.per_x, (_ZERO, t_max))
    stretch = _clip(box.low_y, box.high_y, ray.y, ray.per_y, stretch)
    near, far = _clip(box.low_z, box.high_z, ray.z, ray.per_z, stretch)
    return near * _NEARER <= far * _FARTHER


@njit_no_refcount(forceinline=True)
def enters_any_box(ray: _Ray, boxes: Float32[np.ndarray, "6 b"], t_max: np.float32) -> bool:
    """Return whether a ray enters one of the boxes before ``t_max``, or begins in it."""
    entered = 0
    for number in range(boxes.shape[1]):
        b = np.uintp(number)  # unsigned: no place is counted from the end of an array
        box = _Box(boxes[0, b], boxes[1, b], boxes[2, b], boxes[3, b], boxes[4, b], boxes[5, b])
        entered |= _enters(ray, box, t_max)
    return entered != 0


@njit_no_refcount(forceinline=True)
def _box_around(boxes: Float32[np.ndarray, "6 b"]) -> _Box:
    """Return the box around all boxes."""
    low_x, low_y, low_z = boxes[0, 0], boxes[1, 0], boxes[2, 0]
    high_x, high_y, high_z = boxes[3, 0], boxes[4, 0], boxes[5, 0]
    for b in range(1, boxes.shape[1]):
        low_x, high_x = min(low_x, boxes[0, b]), max(high_x, boxes[3, b])
        low_y, high_y = min(low_y, boxes[1, b]), max(high_y, boxes[4, b])
        low_z, high_z = min(low_z, boxes[2, b]), max(high_z, boxes[5, b])
    return _Box(low_x, low_y, low_z, high_x, high_y, high_z)


@njit_no_refcount(forceinline=True)
def end_paths_in_boxes(
    boxes: Float32[np.ndarray, "6 b"],
    bounce: Bounce,
    count: int,
    paths_per_pixel: int,
    rows: Int32[np.ndarray, " r"],
    enters: Bool[np.ndarray, " i"],
) -> bool:
    """End the rays of the first ``count`` rows that enter a box before what they hit; mark their pixels.

    Pixels are numbered as they come, ``paths_per_pixel`` to each; rows are in their order, and none is of a
    pixel that is marked already. The rays of a pixel after one that enters are ended, too. ``rows`` is
    scratch memory. Returns whether any ray was ended.
    """
    paths, faces, distances = bounce.paths, bounce.hits.faces, bounce.hits.distances
    around = _box_around(boxes)
    found = np.int32(0)
    for row in range(count):
        i = np.uintp(row)
        q = np.uintp(bounce.active[i])
        ray = make_ray(paths.origins_world[q], paths.directions_world[q])
        comes_near = np.int32(_enters(ray, around, distances[i]))
        rows[i] = comes_near
        found |= comes_near
    if found == 0:
        return False
    is_any_ended = False
    pixel, next_first = 0, paths_per_pixel
    for k in range(count):
        p = bounce.active[k]
        # no division: one takes longer than all else here
        while p >= next_first:
            pixel, next_first = pixel + 1, next_first + paths_per_pixel
        if rows[k] != 0 and not enters[pixel]:
            ray = make_ray(paths.origins_world[p], paths.directions_world[p])
            enters[pixel] = enters_any_box(ray, boxes, distances[k])
        if enters[pixel]:
            faces[k] = PATH_ENDED
            is_any_ended = True
    return is_any_ended


@njit_no_refcount(forceinline=True)
def mark_shadows_in_boxes(
    boxes: Float32[np.ndarray, "6 b"],
    bounce: Bounce,
    count: int,
    paths_per_pixel: int,
    rows: Int32[np.ndarray, " r"],
    enters: Bool[np.ndarray, " i"],
) -> bool:
    """Mark the pixels of the first ``count`` rows whose shadow rays bring light and enter a box.

    ``rows`` is scratch memory. Returns whether any is marked that was not.
    """
    shadows = bounce.shadows
    around = _box_around(boxes)
    found = np.int32(0)
    for row in range(count):
        i = np.uintp(row)
        ray = make_ray(shadows.origins_world[i], shadows.directions_world[i])
        radiance = shadows.radiance_linear[i]
        is_lit = (
            np.int32(radiance[0] != _ZERO) | np.int32(radiance[1] != _ZERO) | np.int32(radiance[2] != _ZERO)
        )
        comes_near = is_lit & np.int32(_enters(ray, around, shadows.t_max[i]))
        rows[i] = comes_near
        found |= comes_near
    if found == 0:
        return False
    is_any_new = False
    pixel, next_first = 0, paths_per_pixel
    for k in range(count):
        while bounce.active[k] >= next_first:
            pixel, next_first = pixel + 1, next_first + paths_per_pixel
        if rows[k] != 0 and not enters[pixel]:
            ray = make_ray(shadows.origins_world[k], shadows.directions_world[k])
            enters[pixel] = enters_any_box(ray, boxes, shadows.t_max[k])
            is_any_new = is_any_new or enters[pixel]
    return is_any_new
