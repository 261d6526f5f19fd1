"""Which way an environment map lies in the world."""

import numpy as np
from jaxtyping import Float64


def environment_frame(
    up_world: Float64[np.ndarray, "3"], rotation_degrees: float = 0.0
) -> Float64[np.ndarray, "3 3"]:
    """Return right, up and forward of a map, as rows.

    Forward, where the middle column lies, is the world's z made level, or its x where z is about up. The
    rotation turns it to the left, seen from above anticlockwise.
    """
    up = up_world / np.linalg.norm(up_world)
    # up must not be parallel to it
    ahead = np.array([1.0, 0.0, 0.0]) if abs(up[2]) > 0.9 else np.array([0.0, 0.0, 1.0])
    ahead = ahead - (ahead @ up) * up
    ahead /= np.linalg.norm(ahead)
    left = np.cross(up, ahead)
    angle = np.radians(rotation_degrees)
    forward = np.cos(angle) * ahead + np.sin(angle) * left
    return np.stack([np.cross(forward, up), up, forward])
