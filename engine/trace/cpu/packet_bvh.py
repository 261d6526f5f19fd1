"""The bounding-volume hierarchy of packet tracing, as arrays.

Their layout is described in :mod:`octasplat.engine.trace.cpu.kernels.packet_bvh`.
"""

import numpy as np
from jaxtyping import Float32, Int32

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.trace.cpu.kernels.kernel_args import BvhArrays
from octasplat.engine.trace.cpu.kernels.packet_bvh import (
    BOX_ROWS,
    INVALID_KEY,
    KEY_BITS,
    LEAF_ROWS,
    MAX_CELL,
    WIDTH,
    morton_keys,
    refit_blocks,
    update_leaves,
    write_leaves,
    write_upper_levels,
)
from octasplat.engine.trace.cpu.kernels.radix_sort import stable_argsort
from octasplat.engine.trace.cpu.memory import aligned_empty

_GRID_SAMPLE = 4096


class PacketBvh:
    """Hierarchy of eight boxes per node over blocks of eight Gaussians along a Z-order curve.

    Args:
        primitives: of all Gaussians; those that are not finite are left out.
        threads: how many to take at most; the hierarchy is the same on any number.

    Attributes:
        arrays: the hierarchy as kernels take it.
    """

    arrays: BvhArrays

    def __init__(self, primitives: Float32[np.ndarray, "n 16"], threads: int = 1) -> None:
        count = len(primitives)
        keys = np.empty(count, np.uint64)
        low, cell = _curve_grid(primitives[:, :3])
        run_ranges(morton_keys, threads, count, primitives, low, 1.0 / cell, keys)
        order, sorted_keys = stable_argsort(keys, KEY_BITS, threads)
        # keys of Gaussians that are not finite are the largest: these come last, and are cut off
        order = order[: int(np.searchsorted(sorted_keys, INVALID_KEY))]
        blocks = -(-len(order) // WIDTH)
        # --- sizes of the levels, from the blocks' boxes up to a single node ---
        sizes = [max(1, -(-blocks // WIDTH))]
        while sizes[-1] > 1:
            sizes.append(-(-sizes[-1] // WIDTH))
        level_starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        nodes = aligned_empty((int(level_starts[-1]), BOX_ROWS, WIDTH))
        nodes[:, :3] = np.inf
        nodes[:, 3:] = -np.inf  # boxes turned inside out are in no pyramid
        self.arrays = BvhArrays(nodes, level_starts, aligned_empty((blocks, LEAF_ROWS, WIDTH)), order)
        self._slots = np.full(count, -1, np.int32)
        run_ranges(
            write_leaves, threads, blocks, self.arrays.leaf_blocks, self._slots, primitives, order, nodes
        )
        write_upper_levels(nodes, level_starts)
        self._dirty = np.zeros(blocks, np.bool_)
        self._threads = threads

    def refresh(self, primitives: Float32[np.ndarray, "n 16"], ids: Int32[np.ndarray, " u"]) -> None:
        """Copy the changed records of ``ids``, and refit the boxes around them.

        The boxes are then those of a new build along the old curve.
        """
        nodes, level_starts, blocks, _order = self.arrays
        run_ranges(update_leaves, self._threads, len(ids), blocks, self._slots, primitives, ids, self._dirty)
        run_ranges(refit_blocks, self._threads, len(blocks), blocks, self._dirty, nodes)
        write_upper_levels(nodes, level_starts)


def _curve_grid(means_world: Float32[np.ndarray, "n 3"]) -> tuple[np.ndarray, float]:
    """Return origin and cell size of the curve's grid: the central 98 % of the means' box, padded."""
    sample = means_world[:: max(1, len(means_world) // _GRID_SAMPLE)].astype(np.float64)
    sample = sample[np.isfinite(sample).all(axis=1)]
    if len(sample) == 0:
        return np.zeros(3), 1.0
    # quantiles: a few means far away must not make the cells coarse
    low, high = np.quantile(sample, [0.01, 0.99], axis=0)
    size = max(float((high - low).max()), 1e-30)
    return low - 0.25 * size, 1.5 * size / MAX_CELL
