"""Square patches of neighbouring rays in a batch, and the order of their rays.

A patch is a grid of cells, one ray in each. Its rays follow a Z-order curve, so that neighbours in the batch
are close together, as the tracer's packets want them. What compares neighbours needs rows and columns
instead: :meth:`RayPatches.grid` and :meth:`RayPatches.flatten` convert between the two.
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
    """Patches among the rays of a batch, one after another.

    Attributes:
        first: the first ray that is in a patch.
        count: number of patches.
        side: cells of a patch each way.
    """

    first: int
    count: int
    side: int

    @property
    def rays(self) -> slice:
        """Return the rays of all patches."""
        return slice(self.first, self.first + self.count * self.side**2)

    def grid(self, values: Shaped[np.ndarray, "c ..."]) -> Shaped[np.ndarray, "w s s ..."]:
        """Return values of the patches' rays by patch, row and column."""
        rows, columns = morton_cells(self.side)
        grid = np.empty((self.count, self.side, self.side, *values.shape[1:]), values.dtype)
        grid[:, rows, columns] = values.reshape(self.count, self.side**2, *values.shape[1:])
        return grid

    def flatten(self, grid: Float64[np.ndarray, "w s s ..."]) -> Float64[np.ndarray, "c ..."]:
        """Return values by patch, row and column in the order of the patches' rays."""
        rows, columns = morton_cells(self.side)
        return grid[:, rows, columns].reshape(-1, *grid.shape[3:])
