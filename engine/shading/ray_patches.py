"""Square windows of neighbouring rays in a batch, and the order in which their rays stand.

A window is a grid of cells, one ray in each. Rays of a window stand along a Z-order curve, so that those side
by side in the batch are close together, as the tracer's packets want them. What compares neighbours needs
rows and columns instead: :meth:`RayPatches.grid` and :meth:`RayPatches.flat` change between the two.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float64, Int64, Shaped


@lru_cache(maxsize=8)
def morton_cells(side: int) -> tuple[Int64[np.ndarray, " c"], Int64[np.ndarray, " c"]]:
    """Return row and column of each cell of a square of ``side`` x ``side`` cells, along a Z-order curve.

    >>> [(int(row), int(column)) for row, column in zip(*morton_cells(2))]
    [(0, 0), (0, 1), (1, 0), (1, 1)]
    """
    rows, columns = np.divmod(np.arange(side * side), side)
    place = np.zeros(side * side, np.int64)
    for bit in range(side.bit_length()):
        place |= (rows >> bit & 1) << (2 * bit + 1) | (columns >> bit & 1) << (2 * bit)
    order = np.argsort(place)
    return rows[order], columns[order]


@dataclass(frozen=True)
class RayPatches:
    """Windows among the rays of a batch, one after another.

    Attributes:
        first: the first ray that is in a window.
        count: number of windows.
        side: cells of a window each way.
    """

    first: int
    count: int
    side: int

    @property
    def rays(self) -> slice:
        """Return the rays of all patches."""
        return slice(self.first, self.first + self.count * self.side**2)

    def grid(self, values: Shaped[np.ndarray, "c ..."]) -> Shaped[np.ndarray, "w s s ..."]:
        """Return values of the windows' rays by window, row and column."""
        rows, columns = morton_cells(self.side)
        grid = np.empty((self.count, self.side, self.side, *values.shape[1:]), values.dtype)
        grid[:, rows, columns] = values.reshape(self.count, self.side**2, *values.shape[1:])
        return grid

    def flatten(self, grid: Float64[np.ndarray, "w s s ..."]) -> Float64[np.ndarray, "c ..."]:
        """Return values by window, row and column in the order of the windows' rays."""
        rows, columns = morton_cells(self.side)
        return grid[:, rows, columns].reshape(-1, *grid.shape[3:])
