"""Axes that a mesh format or an editor changed.

glTF and (by custom) OBJ have y up, Blender has z up. A mesh that goes in and out by the same format comes
back as it was, one that changes format comes back turned by a multiple of 90 degrees about x.
"""

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float64

Axes = Literal["x0", "x90", "x180", "x270"]
"""Angle in degrees by which a file's coordinates must be turned about x to be the scene's."""

AXIS_ROTATIONS: dict[Axes, Float64[np.ndarray, "3 3"]] = {
    "x0": np.eye(3),
    "x90": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "x180": np.diag([1.0, -1, -1]),
    "x270": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
}
MIN_AXES_GAIN = 0.5
"""Another turn must at least halve the median distance to be believed."""


def default_axes(path: Path) -> Axes:
    """Return the rotation of an exported file: that of the root node for GLB (180 degrees)."""
    return "x180" if path.suffix.lower() == ".glb" else "x0"


def detect_axes(
    usual: Axes,
    corners: Float64[np.ndarray, "n 8 3"],
    present: Bool[np.ndarray, "n 8"],
    unedited_world: Float[np.ndarray, "n 8 3"],
) -> Axes:
    """Return the rotation that brings most vertices back to their exported places, by median distance."""
    edited, unedited = corners[present], unedited_world[present].astype(np.float64)
    if len(edited) == 0:
        return usual
    distances = {
        name: float(np.median(np.linalg.norm(edited @ turn.T - unedited, axis=-1)))
        for name, turn in AXIS_ROTATIONS.items()
    }
    best = min(distances, key=lambda name: distances[name])
    return best if distances[best] < MIN_AXES_GAIN * distances[usual] else usual
