"""Fewer Gaussians that look alike: neighbors are merged, two at a time, by the moments of their mixture.

What becomes of a pair is said in :mod:`octasplat.engine.gaussians.pair_moments`; which pairs are merged is
decided by what they lose, see :mod:`octasplat.engine.gaussians.neighbor_pairs`.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Int64

from octasplat.engine.gaussians.flattening import row_slices
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.neighbor_pairs import choose_pairs
from octasplat.engine.gaussians.pair_moments import merged_pairs
from octasplat.engine.gaussians.rows import allocate_rows

MAX_SHARE_PER_ROUND = 0.3
"""Most of all Gaussians that are merged away in a round: the best pairs of many, rather than all pairs."""


def simplify(
    gaussians: FlatGaussians,
    count: int,
    on_round: Callable[[int], None] = lambda _count: None,
    folder: Path | None = None,
) -> FlatGaussians:
    """Return ``count`` Gaussians that look about like the given ones; these if there are no more.

    The result does not depend on anything random.

    Args:
        gaussians: the scene.
        count: how many to leave, 1 at least.
        on_round: called with the number that are left, after each round; it may raise to stop.
        folder: for files that hold the result and most of what there is on the way. Without one, 110 bytes
            for each Gaussian are in memory on the way, and up to 0.7 of the scene again.

    Raises:
        DiskFullError: there is no room for the files.

    Example:
        >>> row = FlatGaussians(
        ...     means_world=np.array([[0, 0, 0], [0.1, 0, 0], [5, 0, 0]], np.float32),
        ...     quats_wxyz=np.tile(np.float32([1, 0, 0, 0]), (3, 1)),
        ...     log_scales=np.full((3, 2), -2, np.float32),
        ...     opacity_logits=np.zeros(3, np.float32),
        ...     sh=np.zeros((3, 1, 3), np.float32),
        ... )
        >>> simplify(row, 2).means_world[:, 0].astype(float).round(2).tolist()
        [0.05, 5.0]
    """
    target: FlatGaussians | None = None
    while len(gaussians) > count:
        wanted = min(len(gaussians) - count, max(1, int(MAX_SHARE_PER_ROUND * len(gaussians))))
        first, second = choose_pairs(gaussians, wanted, folder)
        if target is None:
            target = allocate_rows(gaussians, len(gaussians) - len(first), folder)
        gaussians = _merge_pairs(gaussians, first, second, target)
        on_round(len(gaussians))
    if folder is None and target is not None and len(gaussians) < len(target):
        return gaussians.copy()  # what is no longer needed of the first round is let go
    return gaussians


def _merge_pairs(
    gaussians: FlatGaussians,
    first: Int64[np.ndarray, " p"],
    second: Int64[np.ndarray, " p"],
    target: FlatGaussians,
) -> FlatGaussians:
    """Return the Gaussians with each pair merged in the place of its first, which comes before its second.

    They are written to the beginning of ``target``. That may be what the Gaussians are a view of, as no row
    is written before it and those before it have been read.
    """
    partners = np.full(len(gaussians), -1, np.int64 if len(gaussians) > np.iinfo(np.int32).max else np.int32)
    partners[first] = second
    is_left = np.ones(len(gaussians), np.bool_)
    is_left[second] = False
    end = 0
    for rows in row_slices(len(gaussians)):
        left = rows.start + np.flatnonzero(is_left[rows])
        block = gaussians.select(left)
        places = np.flatnonzero(partners[left] >= 0)
        if len(places):
            block.put(places, merged_pairs(gaussians, left[places], partners[left[places]]))
        target.put(slice(end, end + len(left)), block)
        end += len(left)
    return target.view(slice(0, end))
