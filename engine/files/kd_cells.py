"""Cells of space that halve the points of a scene again and again; other points are sorted into them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int, Int32, Int64

from octasplat.engine.files.kd_split import all_rows
from octasplat.engine.gaussians.flattening import row_slices

SPREAD_QUANTILES = (0.05, 0.95)
"""Between which a cell is measured, so that a few points far away do not say how it is cut."""


@dataclass(frozen=True, eq=False)
class KdCells:
    """A binary tree of planes along the axes.

    Cells of depth d have the numbers 0 to 2^d - 1; those of cell c are 2 c, below its plane, and 2 c + 1.

    Attributes:
        axes: of the planes of each depth, 0 to 2.
        places: where they are on the axis.
    """

    axes: tuple[Int64[np.ndarray, " _"], ...]
    places: tuple[Float64[np.ndarray, " _"], ...]

    def cells_of(self, points: Float[np.ndarray, "n 3"], depth: int) -> Int32[np.ndarray, " n"]:
        """Return the cell of each point at a depth, 0 to that of the tree."""
        return np.concatenate([self._cells_of(points[rows], depth) for rows in row_slices(len(points))])

    def _cells_of(self, points: Float[np.ndarray, "n 3"], depth: int) -> Int32[np.ndarray, " n"]:
        cells = np.zeros(len(points), np.int32)
        rows = np.arange(len(points))
        for axes, places in zip(self.axes[:depth], self.places[:depth], strict=True):
            cells = 2 * cells + (points[rows, axes[cells]] >= places[cells])
        return cells


def halve_points(points: Float[np.ndarray, "n 3"], depth: int) -> KdCells:
    """Return a tree of planes through the medians of the points, each along the widest side of its cell.

    Args:
        points: at least one.
        depth: of the tree, 30 at most; 0 is one cell for everything.
    """
    axes: list[Int64[np.ndarray, " _"]] = []
    places: list[Float64[np.ndarray, " _"]] = []
    parts = [all_rows(points)]
    for at in range(depth):
        planes = [_plane(points, part) for part in parts]
        axes.append(np.array([axis for axis, _ in planes], np.int64))
        places.append(np.array([place for _, place in planes], np.float64))
        if at + 1 == depth:
            break
        halves: list[Int[np.ndarray, " _"]] = []
        for part, (axis, place) in zip(parts, planes, strict=True):
            is_above = points[part, axis] >= np.float64(place)  # whose bits 32 may not hold
            halves += [part[~is_above], part[is_above]]
        parts = halves
    return KdCells(tuple(axes), tuple(places))


def _plane(points: Float[np.ndarray, "n 3"], part: Int[np.ndarray, " m"]) -> tuple[int, float]:
    if len(part) == 0:
        return 0, 0.0
    spreads, medians = zip(*(_spread_and_median(points[part, axis]) for axis in range(3)), strict=True)
    axis = int(np.argmax(spreads))
    return axis, medians[axis]


def _spread_and_median(coordinates: Float[np.ndarray, " m"]) -> tuple[float, float]:
    values = coordinates.astype(np.float64)
    low, high = np.quantile(values, SPREAD_QUANTILES, overwrite_input=True)
    return float(high - low), float(np.median(values, overwrite_input=True))
