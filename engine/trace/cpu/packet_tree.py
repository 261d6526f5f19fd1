"""The packets' hierarchy as arrays.

Their layout is described in :mod:`octasplat.engine.trace.cpu.kernels_tree`.
"""

import numpy as np
from jaxtyping import Float32, Int32

from octasplat.engine.compilation import run_ranges
from octasplat.engine.trace.cpu.kernels_packet_walk import Tree
from octasplat.engine.trace.cpu.kernels_sort import stable_order
from octasplat.engine.trace.cpu.kernels_tree import (
    BOX_ROWS,
    KEY_BITS,
    LEAF_ROWS,
    LEFT_OUT,
    TOP_CELL,
    WIDTH,
    curve_keys,
    refit_blocks,
    refresh_leaves,
    write_leaves,
    write_upper_levels,
)
from octasplat.engine.trace.cpu.memory import aligned_empty

_SAMPLE = 4096


class PacketTree:
    """Eight boxes a node over blocks of eight Gaussians along a Z-order curve.

    Args:
        records: of all Gaussians; those that are not finite are left out.
        threads: how many to take at most; the hierarchy is the same on any number.

    Attributes:
        arrays: the hierarchy as kernels take it.
    """

    arrays: Tree

    def __init__(self, records: Float32[np.ndarray, "n 16"], threads: int = 1) -> None:
        count = len(records)
        keys = np.empty(count, np.uint64)
        low, cell = _grid(records[:, :3])
        run_ranges(curve_keys, threads, count, records, low, 1.0 / cell, keys)
        order, sorted_keys = stable_order(keys, KEY_BITS, threads)
        order = order[: int(np.searchsorted(sorted_keys, LEFT_OUT))]
        blocks = -(-len(order) // WIDTH)
        sizes = [max(1, -(-blocks // WIDTH))]
        while sizes[-1] > 1:
            sizes.append(-(-sizes[-1] // WIDTH))
        level_starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        nodes = aligned_empty((int(level_starts[-1]), BOX_ROWS, WIDTH))
        nodes[:, :3] = np.inf
        nodes[:, 3:] = -np.inf  # boxes turned inside out are in no pyramid
        self.arrays = Tree(nodes, level_starts, aligned_empty((blocks, LEAF_ROWS, WIDTH)), order)
        self._slots = np.full(count, -1, np.int32)
        run_ranges(write_leaves, threads, blocks, self.arrays.blocks, self._slots, records, order, nodes)
        write_upper_levels(nodes, level_starts)
        self._touched = np.zeros(blocks, np.bool_)
        self._threads = threads

    def refresh(self, records: Float32[np.ndarray, "n 16"], ids: Int32[np.ndarray, " u"]) -> None:
        """Take the changed records of ``ids`` over, and refit the boxes around them.

        The boxes are then those of a new build along the old curve.
        """
        nodes, level_starts, blocks, _order = self.arrays
        run_ranges(refresh_leaves, self._threads, len(ids), blocks, self._slots, records, ids, self._touched)
        run_ranges(refit_blocks, self._threads, len(blocks), blocks, self._touched, nodes)
        write_upper_levels(nodes, level_starts)


def _grid(means_world: Float32[np.ndarray, "n 3"]) -> tuple[np.ndarray, float]:
    """Origin and cell size of the curve's grid: the box of the central 98 % with room around it."""
    sample = means_world[:: max(1, len(means_world) // _SAMPLE)].astype(np.float64)
    sample = sample[np.isfinite(sample).all(axis=1)]
    if len(sample) == 0:
        return np.zeros(3), 1.0
    low, high = np.quantile(sample, [0.01, 0.99], axis=0)
    size = max(float((high - low).max()), 1e-30)
    return low - 0.25 * size, 1.5 * size / TOP_CELL
