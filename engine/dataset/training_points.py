"""Sparse points that the training photographs determine without the held-out ones.

A point that only held-out photographs observe, or one training photograph and a held-out one, reveals where
the surface is that the held-out views are evaluated on. Training must not start from it.
"""

import numpy as np
from jaxtyping import Bool, Int64

from octasplat.engine.dataset.model import Observations, SparsePoints

MIN_OBSERVATIONS = 2
"""So many training photographs give a point its place."""


def is_observed_by(
    views: Int64[np.ndarray, " t"], points: SparsePoints, observations: Observations
) -> Bool[np.ndarray, " n"]:
    """Return which points at least two of ``views`` observe.

    All count where no photograph is said to show any, or where none would be left.

    Args:
        views: indices of the training views.
        points: sparse points; their ids ascend.
        observations: of the points.
    """
    if len(points) == 0 or len(observations) == 0:
        return np.ones(len(points), np.bool_)
    row, is_there = points.rows_of(observations.point)
    counted = np.isin(observations.view, views) & is_there
    # A track may name a photograph twice, which tells no more than once.
    stride = int(observations.view.max()) + 1
    # Sorted: np.unique looks numbers up in a table, which takes many times as long for millions of them.
    pairs = np.sort(row[counted] * stride + observations.view[counted])
    once = pairs[np.diff(pairs, prepend=-1) > 0]
    known = np.bincount(once // stride, minlength=len(points)) >= MIN_OBSERVATIONS
    return known if known.any() else np.ones(len(points), np.bool_)


def training_points(
    views: Int64[np.ndarray, " t"], points: SparsePoints, observations: Observations
) -> SparsePoints:
    """Return the points that at least two of ``views`` observe; see :func:`is_observed_by`."""
    known = is_observed_by(views, points, observations)
    return SparsePoints(
        points.xyz_world[known],
        points.rgb_srgb[known],
        points.track_lengths[known],
        points.errors_px[known],
        points.ids[known],
    )
