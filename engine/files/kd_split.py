"""Splitting a scene into compact parts, for viewers that sort whole objects and for tight bounds."""

import numpy as np
from jaxtyping import Float, Float64, Int

MIN_CHUNK_SIZE = 256
POINTS_AT_ONCE = 1 << 16


def kd_split(points_world: Float[np.ndarray, "n 3"], max_chunks: int) -> list[Int[np.ndarray, "_"]]:
    """Return indices of ``points_world`` in spatially compact chunks of equal size (give or take one point).

    Each part is halved at the median along the axis on which it spreads most, while there may be twice as
    many chunks and none falls below ``MIN_CHUNK_SIZE`` points. Within a chunk the order is ascending.
    """
    chunks = [all_rows(points_world)]
    while 2 * len(chunks) <= max_chunks and len(points_world) // (2 * len(chunks)) >= MIN_CHUNK_SIZE:
        chunks = [half for chunk in chunks for half in _split_in_half(points_world, chunk)]
    return [np.sort(chunk) for chunk in chunks]


def _split_in_half(
    points_world: Float[np.ndarray, "n 3"], chunk: Int[np.ndarray, " m"]
) -> tuple[Int[np.ndarray, " a"], Int[np.ndarray, " b"]]:
    middle = len(chunk) // 2
    order = np.argpartition(points_world[chunk, _widest_axis(points_world, chunk)], middle)
    return chunk[order[:middle]], chunk[order[middle:]]


def _widest_axis(points_world: Float[np.ndarray, "n 3"], chunk: Int[np.ndarray, " m"]) -> int:
    """Return the axis of the largest standard deviation, as ``np.std`` of all points at once has it."""
    mean = _column_sums(points_world, chunk, np.zeros(3), power=1) / len(chunk)
    variance = _column_sums(points_world, chunk, mean, power=2) / len(chunk)
    return int(np.argmax(np.sqrt(variance)))


def _column_sums(
    points_world: Float[np.ndarray, "n 3"], chunk: Int[np.ndarray, " m"], origin: np.ndarray, power: int
) -> Float64[np.ndarray, "3"]:
    """Return sums over points of powers of their coordinates, added up row by row whatever the blocks."""
    total = np.zeros((1, 3))
    for start in range(0, len(chunk), POINTS_AT_ONCE):
        points = points_world[chunk[start : start + POINTS_AT_ONCE]].astype(np.float64) - origin
        terms = points * points if power == 2 else points
        total = np.concatenate([total, terms]).sum(axis=0, keepdims=True)
    return np.asarray(total[0])


def all_rows(points_world: Float[np.ndarray, "n 3"]) -> Int[np.ndarray, " n"]:
    """Return the numbers of all points, of 32 bits where these do, as they are most of what is in memory."""
    kind = np.int32 if len(points_world) <= np.iinfo(np.int32).max else np.int64
    return np.arange(len(points_world), dtype=kind)


def kd_order(points_world: Float[np.ndarray, "n 3"], chunk: int) -> Int[np.ndarray, " n"]:
    """Return an order of the points in which every run of ``chunk`` of them lies close together.

    Parts are split across their longest side between whole chunks, where the sides of both halves, weighted
    by their numbers of points, are shortest in sum. So a few points far from all others end up in chunks of
    their own instead of setting the scale for everything.
    """
    done: list[np.ndarray] = []
    waiting = [all_rows(points_world)]
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
    return np.concatenate([*done, np.zeros(0, dtype=np.int32)])


def _longest_side(points_world: Float[np.ndarray, "n 3"], part: Int[np.ndarray, " m"]) -> int:
    """Return the axis along which some points spread farthest."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for start in range(0, len(part), POINTS_AT_ONCE):
        points = points_world[part[start : start + POINTS_AT_ONCE]]
        low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
    # In the points' own precision, in which sides may be alike
    return int(np.argmax(high.astype(points_world.dtype) - low.astype(points_world.dtype)))
