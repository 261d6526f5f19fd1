"""Tests of rays and boxes: which pixels have paths that may meet Gaussians."""

import numpy as np
from jaxtyping import Bool, Float32

from octasplat.engine.pathtracing.kernels.path_args import PATH_ENDED, Bounce
from octasplat.engine.trace.kernels.native import njit_no_refcount

_LEAST_SLOPE = 1e-12
"""Rays along a box's side count as this steep, so that nothing is divided by zero."""


@njit_no_refcount(forceinline=True)
def _enters_box(
    boxes: Float32[np.ndarray, "b 6"],
    origin: Float32[np.ndarray, "3"],
    direction: Float32[np.ndarray, "3"],
    t_max: float,
) -> bool:
    """Return whether a ray enters one of the boxes before ``t_max``, or begins in it."""
    for box in range(len(boxes)):
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
) -> None:
    """End the rays of the first ``count`` rows that enter a box before what they hit; mark their pixels.

    Pixels are numbered as they come, ``paths_per_pixel`` to each. Rays of pixels that are marked already are
    ended, too.
    """
    paths, faces = bounce.paths, bounce.hits.faces
    for k in range(count):
        p = bounce.active[k]
        pixel = p // paths_per_pixel
        if not enters[pixel]:
            enters[pixel] = _enters_box(
                boxes, paths.origins_world[p], paths.directions_world[p], float(bounce.hits.distances[k])
            )
        if enters[pixel]:
            faces[k] = PATH_ENDED


@njit_no_refcount(forceinline=True)
def mark_shadows_in_boxes(
    boxes: Float32[np.ndarray, "b 6"],
    bounce: Bounce,
    count: int,
    paths_per_pixel: int,
    enters: Bool[np.ndarray, " i"],
) -> None:
    """Mark the pixels of the first ``count`` rows whose shadow rays bring light and enter a box."""
    shadows = bounce.shadows
    for k in range(count):
        pixel = bounce.active[k] // paths_per_pixel
        radiance = shadows.radiance_linear[k]
        if not enters[pixel] and (radiance[0] != 0.0 or radiance[1] != 0.0 or radiance[2] != 0.0):
            enters[pixel] = _enters_box(
                boxes, shadows.origins_world[k], shadows.directions_world[k], float(shadows.t_max[k])
            )
