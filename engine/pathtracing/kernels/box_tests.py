"""Tests of rays and boxes: which pixels have paths that may meet Gaussians."""

import numpy as np
from jaxtyping import Bool, Float32

from octasplat.engine.pathtracing.kernels.path_args import PATH_ENDED, Bounce
from octasplat.engine.trace.kernels.native import njit_no_refcount

_LEAST_SLOPE = 1e-12
"""Rays along a box's side count as this steep, so that nothing is divided by zero."""
_SPHERE_MARGIN, _ROUNDING = 1e-5, 1e-6
"""By which squared radii of spheres around boxes are larger, and room for the rounding of directions."""


@njit_no_refcount(forceinline=True)
def _passes_sphere(
    boxes: Float32[np.ndarray, "b 6"],
    box: int,
    origin: Float32[np.ndarray, "3"],
    direction: Float32[np.ndarray, "3"],
) -> bool:
    """Return whether a ray surely passes the sphere around a box; it costs no division."""
    far = along = radius = 0.0
    for axis in range(3):
        low, high = float(boxes[box, axis]), float(boxes[box, axis + 3])
        way, half = 0.5 * (low + high) - origin[axis], 0.5 * (high - low)
        far += way * way
        along += way * direction[axis]
        radius += half * half
    limit = radius * (1.0 + _SPHERE_MARGIN) + _ROUNDING * far
    # beside it, or behind the ray's origin
    return far - along * along > limit or (along < 0.0 and far > limit)


@njit_no_refcount(forceinline=True)
def _enters_box(
    boxes: Float32[np.ndarray, "b 6"],
    origin: Float32[np.ndarray, "3"],
    direction: Float32[np.ndarray, "3"],
    t_max: float,
) -> bool:
    """Return whether a ray enters one of the boxes before ``t_max``, or begins in it."""
    for box in range(len(boxes)):
        if _passes_sphere(boxes, box, origin, direction):
            continue
        near, far = 0.0, t_max
        for axis in range(3):
            slope = float(direction[axis])
            if abs(slope) < _LEAST_SLOPE:
                slope = _LEAST_SLOPE
            a = (boxes[box, axis] - origin[axis]) / slope
            b = (boxes[box, axis + 3] - origin[axis]) / slope
            near, far = max(near, min(a, b)), min(far, max(a, b))
        if near <= far:
            return True
    return False


@njit_no_refcount(forceinline=True)
def end_paths_in_boxes(
    boxes: Float32[np.ndarray, "b 6"],
    bounce: Bounce,
    count: int,
    paths_per_pixel: int,
    enters: Bool[np.ndarray, " i"],
) -> bool:
    """End the rays of the first ``count`` rows that enter a box before what they hit; mark their pixels.

    Pixels are numbered as they come, ``paths_per_pixel`` to each; rows are in their order. Rays of pixels
    that are marked already are ended, too. Returns whether any ray was ended.
    """
    paths, faces = bounce.paths, bounce.hits.faces
    found = False
    pixel, next_first = 0, paths_per_pixel
    for k in range(count):
        p = bounce.active[k]
        # no division: one takes longer than all else here
        while p >= next_first:
            pixel, next_first = pixel + 1, next_first + paths_per_pixel
        if not enters[pixel]:
            enters[pixel] = _enters_box(
                boxes, paths.origins_world[p], paths.directions_world[p], float(bounce.hits.distances[k])
            )
        if enters[pixel]:
            faces[k] = PATH_ENDED
            found = True
    return found


@njit_no_refcount(forceinline=True)
def mark_shadows_in_boxes(
    boxes: Float32[np.ndarray, "b 6"],
    bounce: Bounce,
    count: int,
    paths_per_pixel: int,
    enters: Bool[np.ndarray, " i"],
) -> bool:
    """Mark the pixels of the first ``count`` rows whose shadow rays bring light and enter a box.

    Returns whether any is marked that was not.
    """
    shadows = bounce.shadows
    found = False
    pixel, next_first = 0, paths_per_pixel
    for k in range(count):
        while bounce.active[k] >= next_first:
            pixel, next_first = pixel + 1, next_first + paths_per_pixel
        radiance = shadows.radiance_linear[k]
        if not enters[pixel] and (radiance[0] != 0.0 or radiance[1] != 0.0 or radiance[2] != 0.0):
            enters[pixel] = _enters_box(
                boxes, shadows.origins_world[k], shadows.directions_world[k], float(shadows.t_max[k])
            )
            found = found or enters[pixel]
    return found
