"""Gaussians back from octagons as they were exported, whatever file holds them."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.files.octagon_batches import MAX_FLOAT_ID
from octasplat.engine.gaussians.flattening import row_slices
from octasplat.engine.gaussians.frames import rotation_matrices
from octasplat.engine.gaussians.octagon import (
    coordinate_rounding_error,
    corner_directions,
    frames_from_octagons,
)

TOLERANCE = 1e-3
"""Octagons further from a regular one than this, as a share of their size, were edited."""
OCTAGONS_PER_BLOCK = 4096
"""Octagons that are dealt with at a time, of which each takes some kilobytes."""
ONE_COLOR_NOTE = "It holds one color of each Gaussian, no harmonics."


def gaussians_from_octagons(
    corners_world: Float32[np.ndarray, "n 8 3"], radii: Float32[np.ndarray, " n"], path: Path
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 4"], Float32[np.ndarray, "n 2"]]:
    """Return centres, rotations and log scales of the Gaussians with these octagons.

    Args:
        corners_world: corner by corner.
        radii: of the octagons, in standard deviations.
        path: named in errors.

    Raises:
        SceneFileError: an octagon is none any more.
    """
    means, quats, log_scales, good = frames_from_octagons(corners_world, radii)
    legs = rotation_matrices(quats.astype(np.float64))[:, :, 1:] * np.exp(log_scales)[:, None, :]
    again = means[:, None] + np.einsum("kc,nic->nki", corner_directions(), legs * radii[:, None, None])
    size = np.linalg.norm(corners_world - means[:, None], axis=2).max(axis=1)
    off = np.linalg.norm(corners_world - again, axis=2).max(axis=1)
    if not good.all() or (off > TOLERANCE * size + 4.0 * coordinate_rounding_error(corners_world)).any():
        raise edited_octagons_error(path)
    return means, quats, log_scales


class OctagonOrder:
    """Where octagons belong that are to follow each other by the numbers of their Gaussians.

    Attributes:
        are_unique: whether no two have the same number, as far as numbers are those of a scene.
    """

    def __init__(self, ids: Float32[np.ndarray, " n"]) -> None:
        """Take the numbers in the order of the file."""
        self._ids = ids
        self.are_unique = False
        self._places = np.zeros(0, np.int32)
        """Of each number that there is the place of its octagon; else of each octagon."""
        if len(ids) and ids.min() >= 0 and ids.max() <= MAX_FLOAT_ID:
            is_there = np.zeros(int(ids.max()) + 1, bool)
            for rows in row_slices(len(ids)):
                is_there[ids[rows].astype(np.int64)] = True
            self._places = np.cumsum(is_there, dtype=np.int32) - np.int32(1)
            self.are_unique = int(self._places[-1]) == len(ids) - 1
        if not self.are_unique:
            order = np.argsort(ids, kind="stable")
            self._places = np.empty(len(ids), np.int64)
            self._places[order] = np.arange(len(ids))

    def places(self, rows: slice) -> Int[np.ndarray, " n"]:
        """Return where the octagons of some rows of the file belong."""
        return self._places[self._ids[rows].astype(np.int64)] if self.are_unique else self._places[rows]


def edited_octagons_error(path: Path) -> SceneFileError:
    """Return what to say of octagons that are not as they were exported."""
    return SceneFileError(
        f"{path}: its octagons are not as they were exported; bring them back with octasplat edit --mesh, "
        "which needs the scene that they came from."
    )


def missing_gaussians_notes(stated: int, found: int) -> tuple[str, ...]:
    """Return what a file of octagons lacks of the scene with ``stated`` Gaussians (0 if it does not say)."""
    if stated <= found:
        return (ONE_COLOR_NOTE,)
    return (ONE_COLOR_NOTE, f"Left out of its octagons were {stated - found:,} fainter Gaussians.")


def is_octagon_ply(head: bytes) -> bool:
    """Return whether a file with this head is a PLY of octagons that carries the ids of their Gaussians."""
    properties = head.partition(b"end_header")[0].replace(b"\r", b"")  # some programs end lines with CR LF
    return head.startswith(b"ply") and all(
        f" {name}\n".encode() in properties for name in ("gid", "corner", "radius")
    )
