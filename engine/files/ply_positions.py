"""Positions of a PLY: those in 64 bits, as other programs have them, are read about a local origin if far.

32 bits would move each Gaussian of a scene in map coordinates by up to half a metre. Files of ours have 32
bits, and say their origin in a comment.
"""

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.local_origin import (
    NO_ORIGIN,
    Origin,
    choose_origin,
    choose_origin_of_place,
    is_set,
)
from octasplat.engine.core.ply_container import PlyHeader, columns
from octasplat.engine.files.place_comments import ORIGIN_KEY

POSITION = ("x", "y", "z")
SAMPLES = 65_536
"""Gaussians, spread evenly over a file, that show where its scene lies and how large it is."""


def asks_for_origin(header: PlyHeader) -> bool:
    """Return whether a file has Gaussians with positions in 64 bits and does not say their origin itself."""
    vertex = header.element("vertex")
    if vertex is None or "f_dc_0" not in vertex.names:
        return False
    is_long = {prop.name: prop.kind == "f8" for prop in vertex.properties if prop.count_kind is None}
    is_stated = any(comment.split()[:1] == [ORIGIN_KEY] for comment in header.comments)
    return not is_stated and set(POSITION) <= set(is_long) and any(is_long[name] for name in POSITION)


def origin_of_positions(table: np.ndarray) -> Origin:
    """Return the local origin that positions in 64 bits ask for, zeros where they are near their origin."""
    rows = np.unique(np.linspace(0, len(table) - 1, min(SAMPLES, len(table))).astype(np.int64))
    points = np.stack([np.asarray(table[name][rows], np.float64) for name in POSITION], axis=1)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return NO_ORIGIN
    centre = np.median(points, axis=0)
    with np.errstate(over="ignore"):  # of what is refused later
        extent = float(np.median(np.linalg.norm(points - centre, axis=1)))
    if extent == 0.0:
        return choose_origin_of_place(centre, _median_size(table[rows]))
    return choose_origin(centre, extent)


def _median_size(table: np.ndarray) -> float:
    """Return the median scale of some Gaussians of a table, 0 where it says none."""
    names = [name for name in ("scale_0", "scale_1", "scale_2") if name in (table.dtype.names or ())]
    logs = np.array([np.asarray(table[name], np.float64) for name in names])
    with np.errstate(over="ignore"):
        return float(np.exp(np.median(logs))) if np.isfinite(logs).all() and logs.size else 0.0


def positions_about(table: np.ndarray, origin: Origin) -> Float32[np.ndarray, "n 3"]:
    """Return the positions of a table about a local origin."""
    if not is_set(origin):
        return columns(table, POSITION)
    found = np.empty((len(table), 3), np.float32)
    with np.errstate(over="ignore"):
        for axis, name in enumerate(POSITION):
            found[:, axis] = table[name].astype(np.float64) - origin[axis]
    return found
