"""Image motion: derivatives of projected points with respect to the pose of a camera."""

import numpy as np
from jaxtyping import Float64

from octasplat.engine.dataset.camera import Camera

DEPTH_STEP_RATIO = 1e-4
"""Slopes of the projection are differences over this share of the middle depth."""


def image_motion_by_pose(
    points_cam: Float64[np.ndarray, "n 3"], camera: Camera, depth: float
) -> Float64[np.ndarray, "n 2 6"]:
    """Return the image motion (px) by a rotation (rad) of the points and a translation in units of ``depth``.

    Args:
        points_cam: the points in camera coordinates.
        camera: projects them.
        depth: unit of the shift, about as far away as the points are.

    Returns:
        Derivatives by the rotation vector and the shift; 0 where a point is not in the picture.
    """
    here, length = camera.project(points_cam), DEPTH_STEP_RATIO * depth
    by_point = np.stack(
        [(camera.project(points_cam + length * axis) - here) / length for axis in np.eye(3)], axis=2
    )
    x, y, z = points_cam.T
    zero = np.zeros_like(x)
    # d(w x p) / dw = -[p]x: the points as a rotation w about the camera moves them
    by_turn = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    flow = np.concatenate([np.einsum("nij,njk->nik", by_point, by_turn), depth * by_point], axis=2)
    return np.where(np.isfinite(flow), flow, 0.0)
