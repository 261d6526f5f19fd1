"""Splitting a scene into compact parts, for viewers that sort whole objects and for tight bounds."""

import numpy as np
from jaxtyping import Float, Int

MIN_CHUNK_SIZE = 256
POINTS_AT_ONCE = 1 << 16


def kd_split(points_world: Float[np.ndarray, "n 3"], max_chunks: int) -> list[Int[np.ndarray, "_"]]:
    """Return indices of ``points_world`` in spatially compact chunks of equal size (give or take one point).

    Each part is halved at the median along the axis on which it spreads most, while there may be twice as
    many chunks and none falls below ``MIN_CHUNK_SIZE`` points. Within a chunk the order is ascending.
    """
    chunks = [np.arange(len(points_world))]
    while 2 * len(chunks) <= max_chunks and len(points_world) // (2 * len(chunks)) >= MIN_CHUNK_SIZE:
        chunks = [half for chunk in chunks for half in _split_in_half(points_world, chunk)]
    return [np.sort(chunk) for chunk in chunks]


def _split_in_half(
    points_world: Float[np.ndarray, "n 3"], chunk: Int[np.ndarray, " m"]
) -> tuple[Int[np.ndarray, " a"], Int[np.ndarray, " b"]]:
    points = points_world[chunk].astype(np.float64)
    middle = len(chunk) // 2
    order = np.argpartition(points[:, int(np.argmax(points.std(axis=0)))], middle)
    return chunk[order[:middle]], chunk[order[middle:]]


def kd_order(points_world: Float[np.ndarray, "n 3"], chunk: int) -> Int[np.ndarray, " n"]:
    """Return an order of the points in which every run of ``chunk`` of them lies close together.

    Parts are split across their longest side between whole chunks, where the sides of both halves, weighted
    by their numbers of points, are shortest in sum. So a few points far from all others end up in chunks of
    their own instead of setting the scale for everything.
    """
    done: list[np.ndarray] = []
    # of 32 bits where these do, as the order is the most that takes memory here
    kind = np.int32 if len(points_world) <= np.iinfo(np.int32).max else np.int64
    waiting = [np.arange(len(points_world), dtype=kind)]
    while waiting:
        part = waiting.pop()
        if len(part) <= chunk:
            done.append(np.sort(part))
            continue
        axis = _longest_side(points_world, part)
        along = points_world[part, axis]
        order = np.argsort(along, kind="stable")
        splits = np.arange(chunk, len(part), chunk)
        # of the sorted points: the first, the last, and those before and after each split
        first, last, before, after = (
            along[order[places]].astype(np.float64) for places in (0, -1, splits - 1, splits)
        )
        part = part[order]
        del along, order
        costs = splits * (before - first) + (len(part) - splits) * (last - after)
        # Of equally good splits, the one nearest to the middle
        middle = np.abs(2 * splits - len(part))
        best = splits[np.lexsort((middle, costs))[0]]
        waiting += [part[best:], part[:best]]  # a stack: the first half is taken next
    return np.concatenate([*done, np.zeros(0, dtype=kind)])


def _longest_side(points_world: Float[np.ndarray, "n 3"], part: Int[np.ndarray, " m"]) -> int:
    """Return the axis along which some points spread farthest."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for start in range(0, len(part), POINTS_AT_ONCE):
        points = points_world[part[start : start + POINTS_AT_ONCE]]
        low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    # In the points' own precision, in which sides may be alike
    return int(np.argmax(high.astype(points_world.dtype) - low.astype(points_world.dtype)))
