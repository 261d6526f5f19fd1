"""Partition of space into boxes that cost about as much: a k-d tree over weighted points."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from octasplat.engine.core.errors import ConfigError

SPREAD_QUANTILES = (0.05, 0.95)
"""Shares of the weight between which points spread; the few beyond are too far away to matter."""


@dataclass(frozen=True, eq=False)
class Box:
    """An axis-aligned box, world frame; sides that no cut made are infinitely far away.

    Attributes:
        low_world: least coordinates, which belong to the box.
        high_world: coordinates at which it ends, which do not.
    """

    low_world: Float64[np.ndarray, "3"]
    high_world: Float64[np.ndarray, "3"]

    def contains(self, points_world: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return which points are in the box."""
        return np.asarray(((points_world >= self.low_world) & (points_world < self.high_world)).all(axis=1))

    def grown(self, margin_world: Float64[np.ndarray, "3"]) -> "Box":
        """Return the box with its sides farther out by a margin along each axis."""
        return Box(self.low_world - margin_world, self.high_world + margin_world)


def cut_into_boxes(
    points_world: Float[np.ndarray, "n 3"], weights: Float64[np.ndarray, " n"], count: int
) -> tuple[Box, ...]:
    """Return boxes that cover all space without overlap, with about equal weights of the points in each.

    Each cut is across the axis along which the points of a box spread farthest, and gives both sides weights
    in proportion to the boxes that they are to become; so it does not depend on anything random.

    Args:
        points_world: the points.
        weights: what each counts, not negative.
        count: number of boxes.

    Raises:
        ConfigError: there are not so many different points of weight.
    """
    counted = np.flatnonzero(weights > 0)
    everywhere = Box(np.full(3, -np.inf), np.full(3, np.inf))
    return tuple(_cut(points_world[counted].astype(np.float64), weights[counted], everywhere, count))


def weighted_spread(
    points_world: Float64[np.ndarray, "n 3"], weights: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "3"]:
    """Return the distance along each axis that holds nine tenths of the weight, world units."""
    if len(points_world) == 0:
        return np.zeros(3)
    low, high = (
        np.array([_weighted_quantile(points_world[:, axis], weights, share) for axis in range(3)])
        for share in SPREAD_QUANTILES
    )
    return high - low


def _cut(
    points: Float64[np.ndarray, "n 3"], weights: Float64[np.ndarray, " n"], box: Box, count: int
) -> Sequence[Box]:
    if count == 1:
        return [box]
    axes = np.argsort(-weighted_spread(points, weights), kind="stable")
    below_count = count // 2
    for axis in axes.tolist():
        place = _cut_place(points[:, axis], weights, below_count / count)
        if place is not None:
            break
    else:
        raise ConfigError(
            "The scene cannot be cut into so many blocks, since too few different Gaussians are seen; "
            "ask for fewer blocks."
        )
    is_below = points[:, axis] < place
    below_high, above_low = box.high_world.copy(), box.low_world.copy()
    below_high[axis] = above_low[axis] = place
    below, above = Box(box.low_world, below_high), Box(above_low, box.high_world)
    return [
        *_cut(points[is_below], weights[is_below], below, below_count),
        *_cut(points[~is_below], weights[~is_below], above, count - below_count),
    ]


def _cut_place(
    values: Float64[np.ndarray, " n"], weights: Float64[np.ndarray, " n"], share: float
) -> float | None:
    """Return the coordinate below which about ``share`` of the weight lies; None if all values are equal."""
    order = np.argsort(values, kind="stable")
    ordered, sums = values[order], np.cumsum(weights[order])
    steps: Int64[np.ndarray, " k"] = np.flatnonzero(ordered[1:] > ordered[:-1])
    if len(steps) == 0:
        return None
    # between two neighbours of different values, so that no point lies on the cut
    best = steps[np.argmin(np.abs(sums[steps] - share * sums[-1]))]
    middle = 0.5 * (ordered[best] + ordered[best + 1])
    return float(middle if middle > ordered[best] else ordered[best + 1])


def _weighted_quantile(
    values: Float64[np.ndarray, " n"], weights: Float64[np.ndarray, " n"], share: float
) -> float:
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order])
    return float(values[order[min(int(np.searchsorted(sums, share * sums[-1])), len(values) - 1)]])
