"""Replacement of the Gaussians' centres and legs, block by block to save memory."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float64, Int64

from octasplat.engine.gaussians.legs import frames_from_skewed_legs, has_area, surface_rotations
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.spherical_harmonics import rotate_sh

ROWS_PER_BLOCK = 1 << 15
"""Rows of a block: its temporary arrays stay in the processor's cache, and small against the scene."""


def row_blocks(count: int, rows_at_once: int = ROWS_PER_BLOCK) -> Iterator[slice]:
    """Yield slices that cover ``count`` rows in order.

    >>> list(row_blocks(10, 4))
    [slice(0, 4, None), slice(4, 8, None), slice(8, 10, None)]
    """
    for start in range(0, count, rows_at_once):
        yield slice(start, min(start + rows_at_once, count))


def apply_legs(
    old: FlatGaussians,
    means_world: Float64[np.ndarray, "n 3"],
    legs: Float64[np.ndarray, "n 3 2"],
    normal_signs: Float64[np.ndarray, " n"],
    unmoved: Bool[np.ndarray, " n"],
    turn: Float64[np.ndarray, "3 3"] | None = None,
) -> FlatGaussians:
    """Return Gaussians with new centres, legs and rotated harmonics; ``unmoved`` ones stay bit for bit.

    The harmonics turn as the surface does, or all by ``turn`` where the whole map is known. A Gaussian whose
    new legs have no area at all keeps its old frame, scales and color.

    Args:
        old: the Gaussians before.
        means_world: new centres.
        legs: new legs, world frame.
        normal_signs: -1 where space was mirrored, so that the normal lies against leg2 x leg3.
        unmoved: rows that are left alone.
        turn: orthogonal matrix, world to world.
    """
    result = old.copy()
    apply_legs_to(
        gaussians=result,
        rows=np.flatnonzero(~unmoved),
        means_world=means_world,
        legs=legs,
        normal_signs=normal_signs,
        turn=turn,
    )
    return result


def apply_legs_to(
    gaussians: FlatGaussians,
    rows: Int64[np.ndarray, " m"],
    means_world: Float64[np.ndarray, "n 3"],
    legs: Float64[np.ndarray, "n 3 2"],
    normal_signs: Float64[np.ndarray, " n"],
    turn: Float64[np.ndarray, "3 3"] | None = None,
) -> None:
    """Apply new centres and legs in place to ``rows``; all arrays have a row for every Gaussian."""
    for block in row_blocks(len(rows)):
        chosen = rows[block]
        gaussians.means_world[chosen] = means_world[chosen].astype(np.float32)
        # Centers move in any case; a frame needs legs with an area.
        chosen = chosen[has_area(legs[chosen], np.zeros(len(chosen)))]
        part, new_legs, signs = gaussians.select(chosen), legs[chosen], normal_signs[chosen]
        quats, log_scales = frames_from_skewed_legs(new_legs, signs)
        gaussians.quats_wxyz[chosen] = quats.astype(np.float32)
        gaussians.log_scales[chosen] = log_scales.astype(np.float32)
        if part.sh_degree > 0:
            if turn is None:
                turns = surface_rotations(part, new_legs, signs)
            else:
                turns = np.broadcast_to(turn, (len(chosen), 3, 3))
            gaussians.sh[chosen] = rotate_sh(part.sh, turns)
