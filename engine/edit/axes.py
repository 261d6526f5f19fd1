"""Axes that a mesh format or an editor changed, and the octagons' Q.

glTF and (by custom) OBJ have y up, Blender has z up. A mesh that goes in and out by the same format comes
back as it was, one that changes format comes back turned by a multiple of 90 degrees about x.
"""

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float64

from octasplat.engine.files import ImportedMesh
from octasplat.engine.gaussians.octagon import CHI2_2_99, CHI2_3_99

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
Q_TOLERANCE = 1e-3


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


def infer_q(mesh: ImportedMesh, opacities: Float[np.ndarray, " n"], default: float) -> float:
    """Return the Q of an export: as the file states it, else estimated from its octagons, else a default.

    A radius is sqrt(Q + 2 ln a) for opacity a, and the texture coordinates hold radius / sqrt(Q).
    """
    if mesh.q is not None and np.isfinite(mesh.q) and mesh.q > 0:
        return mesh.q
    if mesh.gid is None:
        return default
    with np.errstate(invalid="ignore"):
        known = np.isfinite(mesh.gid) & (mesh.gid > -0.5) & (mesh.gid < len(opacities) - 0.5)
        known &= np.abs(mesh.gid - np.round(mesh.gid)) < 1e-3
    vertices = np.flatnonzero(known)
    logs = np.log(
        np.maximum(opacities[np.round(mesh.gid[vertices]).astype(np.int64)].astype(np.float64), 1e-30)
    )
    estimates = np.zeros(0)
    if mesh.radius is not None:
        estimates = mesh.radius[vertices].astype(np.float64) ** 2 - 2 * logs  # Q = radius^2 - 2 ln a
    elif mesh.uv is not None:
        squares = 4 * np.sum((mesh.uv[vertices].astype(np.float64) - 0.5) ** 2, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            # squares = radius^2 / Q = 1 + 2 ln a / Q; near 1, for opacities near 1, it says nothing of Q.
            estimates = np.where(squares < 0.9, 2 * logs / (squares - 1), np.nan)
    estimates = estimates[np.isfinite(estimates) & (estimates > 0)]
    return _snap_q(float(np.median(estimates))) if len(estimates) else default


def _snap_q(q: float) -> float:
    """Return the nearest round value of Q, where rounding in the file left it a little off."""
    for chosen in (CHI2_2_99, CHI2_3_99, round(q, 2)):
        if abs(q - chosen) <= Q_TOLERANCE * q:
            return chosen
    return q
