"""Spatial order of Gaussians along a Z-order curve, for locality in memory."""

import numpy as np
from jaxtyping import Float, Int64, UInt64

from octasplat.engine.gaussians.kernels.morton_bits import spread_bits

_BITS = 21


def morton_codes(points: Float[np.ndarray, "n 3"]) -> UInt64[np.ndarray, " n"]:
    """Return 63-bit Z-order codes of points in their central 98 % box; points outside are clamped to it."""
    if len(points) == 0:
        return np.zeros(0, np.uint64)
    # Quantiles: a few far points would leave all others in one cell.
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    cell = (points - low) / np.maximum(high - low, 1e-30) * 2**_BITS
    grid = np.clip(cell, 0, 2**_BITS - 1).astype(np.uint64)
    return (
        spread_bits(grid[:, 0])
        | (spread_bits(grid[:, 1]) << np.uint64(1))
        | (spread_bits(grid[:, 2]) << np.uint64(2))
    )


def morton_order(points: Float[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """Return indices that sort points along the Z-order curve; equal codes keep their order."""
    return np.argsort(morton_codes(points), kind="stable")
