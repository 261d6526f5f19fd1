"""Splitting a scene into compact parts, so that viewers that sort whole objects by depth do it well."""

import numpy as np
from jaxtyping import Float, Int

SMALLEST_CHUNK = 256


def kd_chunks(points_world: Float[np.ndarray, "n 3"], max_chunks: int) -> list[Int[np.ndarray, "_"]]:
    """Indices of ``points_world`` in spatially compact chunks of equal size (give or take one point).

    Each part is halved at the median along the axis on which it spreads most, while there may be twice as
    many chunks and none falls below ``SMALLEST_CHUNK`` points. Within a chunk the order is ascending.
    """
    chunks = [np.arange(len(points_world))]
    while 2 * len(chunks) <= max_chunks and len(points_world) // (2 * len(chunks)) >= SMALLEST_CHUNK:
        chunks = [half for chunk in chunks for half in _halves(points_world, chunk)]
    return [np.sort(chunk) for chunk in chunks]


def _halves(
    points_world: Float[np.ndarray, "n 3"], chunk: Int[np.ndarray, " m"]
) -> tuple[Int[np.ndarray, " a"], Int[np.ndarray, " b"]]:
    points = points_world[chunk].astype(np.float64)
    middle = len(chunk) // 2
    order = np.argpartition(points[:, int(np.argmax(points.std(axis=0)))], middle)
    return chunk[order[:middle]], chunk[order[middle:]]
