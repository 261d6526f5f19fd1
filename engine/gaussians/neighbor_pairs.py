"""Pairs of neighbors to be merged: those that lose the least by it, of which no two share a Gaussian.

Everything is gone through some thousands of rows at a time, and what there is for each pair of neighbors may
be in files, so that it takes some 60 bytes of memory for each Gaussian, most of them for the tree.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int, Int64

from octasplat.engine.core.file_arrays import new_array
from octasplat.engine.gaussians.flattening import row_slices
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.pair_moments import pair_costs

NEIGHBORS = 8
"""Nearest Gaussians among which partners are looked for."""
MATCHING_PASSES = 3
"""Pairs whose cost is the least for both are taken; the others look again so many times."""
NO_PAIR = -1

Pairs = tuple[Int64[np.ndarray, " p"], Int64[np.ndarray, " p"], Float64[np.ndarray, " p"]]
"""The smaller row of each, the larger one, and what merging them loses."""


def choose_pairs(
    gaussians: FlatGaussians, wanted: int, folder: Path | None = None
) -> tuple[Int64[np.ndarray, " p"], Int64[np.ndarray, " p"]]:
    """Return at most ``wanted`` pairs without a common member, 1 at least, those of least cost.

    Of pairs with the same cost the one with the smaller first row comes first, then that with the smaller
    second row.

    Args:
        gaussians: two at least.
        wanted: how many.
        folder: for files, see :func:`octasplat.engine.core.file_arrays.new_array`.
    """
    order, partners = _nearest(gaussians.means_world, folder)
    costs = new_array(partners.shape, np.float64, folder)
    for rows in row_slices(len(order)):
        # near to each other, so that few others are looked at
        here = order[rows]
        there = _drop_repeated(here, partners)
        is_pair = there != NO_PAIR
        ends = np.broadcast_to(here[:, None], there.shape)[is_pair], there[is_pair]
        found = np.empty(there.shape)
        found[is_pair] = pair_costs(gaussians, np.minimum(*ends), np.maximum(*ends))
        costs[here] = found
    del order
    is_free = np.ones(len(gaussians), np.bool_)
    chosen = [pairs for _ in range(MATCHING_PASSES) for pairs in _match(partners, costs, is_free)]
    first, second, lost = (np.concatenate(column) for column in zip(*chosen, strict=True))
    cheapest = np.lexsort((second, first, lost))[:wanted]
    return first[cheapest], second[cheapest]


def _nearest(
    points: Float32[np.ndarray, "n 3"], folder: Path | None
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, "n k"]]:
    """Return an order in which points are near to those before, and of each point the nearest ones."""
    from scipy.spatial import KDTree  # here, as most who import this module look for no pairs

    total = len(points)
    count = min(NEIGHBORS + 1, total)
    tree = KDTree(points)
    kind = np.int32 if total <= np.iinfo(np.int32).max else np.int64
    order = tree.indices.astype(kind)
    near = new_array((total, count), kind, folder)
    for rows in row_slices(total):
        here = order[rows]
        near[here] = tree.query(points[here], k=count)[1].reshape(-1, count)
    return order, near


def _drop_repeated(here: Int[np.ndarray, " m"], near: Int[np.ndarray, "n k"]) -> Int[np.ndarray, "m k"]:
    """Return the partners of some rows, each pair only once among all rows; ``near`` has them then, too.

    What stands at the smaller row of a pair stays, so that it does not matter which rows come first.
    """
    there = near[here]
    own = here[:, None]
    is_repeated = there == own
    row, column = np.nonzero(there < own)
    is_repeated[row, column] = (near[there[row, column]] == here[row, None]).any(axis=1)
    there[is_repeated] = NO_PAIR
    near[here] = there
    return there


def _match(
    partners: Int[np.ndarray, "n k"], costs: Float64[np.ndarray, "n k"], is_free: Bool[np.ndarray, " n"]
) -> Iterator[Pairs]:
    """Yield the pairs of free rows which cost the least for both; these are not free any more then."""
    total = len(partners)
    least = np.full(total, np.inf)
    for first, second, lost in _free_pairs(partners, costs, is_free):
        for ends in (first, second):
            np.minimum.at(least, ends, lost)
    best = np.full(total, np.iinfo(np.int64).max)
    for first, second, lost in _free_pairs(partners, costs, is_free):
        keys = first * total + second
        for ends in (first, second):
            is_least = lost == least[ends]
            np.minimum.at(best, ends[is_least], keys[is_least])
    del least
    for first, second, lost in _free_pairs(partners, costs, is_free):
        keys = first * total + second
        is_taken = (best[first] == keys) & (best[second] == keys)
        is_free[first[is_taken]] = is_free[second[is_taken]] = False
        yield first[is_taken], second[is_taken], lost[is_taken]


def _free_pairs(
    partners: Int[np.ndarray, "n k"], costs: Float64[np.ndarray, "n k"], is_free: Bool[np.ndarray, " n"]
) -> Iterator[Pairs]:
    """Yield the pairs both of which are free, of some thousands of rows at a time."""
    for rows in row_slices(len(partners)):
        row, column = np.nonzero((partners[rows] != NO_PAIR) & is_free[rows, None])
        there = partners[rows][row, column].astype(np.int64)
        is_kept = is_free[there]
        here, there, lost = (row + rows.start)[is_kept], there[is_kept], costs[rows][row, column][is_kept]
        yield np.minimum(here, there), np.maximum(here, there), lost
