"""Which way is up, and which way is the front, as cameras tell."""

import numpy as np
from jaxtyping import Float64

MIN_SIDE = 0.05
"""Where the cameras lie this near to the axis, as a share of their distance, any side is the front."""


def estimate_up(rotations_cam_from_world: Float64[np.ndarray, "n 3 3"]) -> Float64[np.ndarray, " 3"]:
    """Return the direction against gravity.

    People tilt cameras up and down but seldom roll them, so it is the direction that is closest to square to
    what all cameras have to their right; a little of their mean up decides where that leaves a choice.
    """
    rights, ups = rotations_cam_from_world[:, 0], -rotations_cam_from_world[:, 1]
    mean = ups.mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length < 1e-3:
        return np.array([0.0, -1.0, 0.0])  # COLMAP's y points down
    mean = mean / length
    # right axes span the plane across up: it is the least eigenvector
    spread = rights.T @ rights / len(rights) + 0.01 * (np.eye(3) - np.outer(mean, mean))
    up = np.linalg.eigh(spread)[1][:, 0]
    agreement = float(up @ mean)
    return np.asarray(up * np.sign(agreement) if abs(agreement) > 0.5 else mean)  # an eigenvector has no sign


def upright_frame(
    rotations_cam_from_world: Float64[np.ndarray, "n 3 3"],
    centres_world: Float64[np.ndarray, "n 3"],
    focus_world: Float64[np.ndarray, "3"],
) -> Float64[np.ndarray, "3 3"]:
    """Return the axes to see a scene upright from the front, as glTF has them: rows right, up, to the viewer.

    Args:
        rotations_cam_from_world: of the cameras.
        centres_world: of the cameras.
        focus_world: what they look at; the front is the side on which they stand in the mean.
    """
    up = estimate_up(rotations_cam_from_world)
    away = centres_world - focus_world
    sideways = away - (away @ up)[:, None] * up
    front = sideways.mean(axis=0)
    # all around: no side is the front
    if np.linalg.norm(front) < MIN_SIDE * np.linalg.norm(sideways, axis=1).mean():
        front = sideways[0]
    if np.linalg.norm(front) < 1e-9:
        front = np.eye(3)[int(np.argmin(np.abs(up)))]
        front = front - (front @ up) * up
    front = front / np.linalg.norm(front)
    return np.stack([np.cross(up, front), up, front])
