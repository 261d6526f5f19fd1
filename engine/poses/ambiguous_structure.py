"""Models in which one thing stands in two places, and the false matches that put it there.

A pattern that repeats (a knitted cloth, tiles) gives matches between photographs of different places. Where
the mapper believes these first, one part of the photographs is put together in itself, but in the wrong place
beside the other part; the true matches between the two then fit nothing, and are left out without a word. So
every pair of photographs is asked how many of its matches are one point of the model, and how many are two.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import ArpackNoConvergence, eigsh

from octasplat.engine.core.colmap_binding import pycolmap

_MAX_INLIER_SHARE_OF_FALSE_PAIR = 0.5
"""A cut is a fold if no more than so many matches across it are kept for one that is broken."""
_MIN_INLIER_SHARE_OF_TRUE_PAIR = 0.5
"""Across a fold, pairs with this share of their matches kept are those that made it."""
_LANCZOS_VECTORS = 60
_MAX_LANCZOS_RESTARTS = 1000


@dataclass(frozen=True, eq=False)
class PairInliers:
    """Counts of inlier and outlier matches for each pair of photographs.

    Attributes:
        pairs: numbers of the photographs in the database.
        inliers: matches whose two features are one point.
        outliers: matches whose features are two different points.
    """

    pairs: Int64[np.ndarray, "p 2"]
    inliers: Int64[np.ndarray, " p"]
    outliers: Int64[np.ndarray, " p"]

    def select(self, is_selected: Bool[np.ndarray, " p"]) -> "PairInliers":
        """Return the counts of some of the pairs."""
        return PairInliers(self.pairs[is_selected], self.inliers[is_selected], self.outliers[is_selected])


def count_pair_inliers(models: Sequence[Any], database: Path) -> PairInliers:
    """Count the inlier and outlier matches of all pairs whose two photographs have poses.

    A photograph counts for the first of the models that has it; no point of one model is one of another.
    """
    points: dict[int, Int64[np.ndarray, " n"]] = {}
    for place, model in enumerate(models):
        for number, image in model.images.items():
            if image.has_pose and number not in points:
                points[number] = np.array(
                    [p.point3D_id * len(models) + place if p.has_point3D() else -1 for p in image.points2D],
                    dtype=np.int64,
                )
    with pycolmap.Database.open(database) as source:
        ids, geometries = source.read_two_view_geometries()
    pairs, kept, broken = [], [], []
    for pair_id, geometry in zip(ids, geometries, strict=True):
        first, second = pycolmap.pair_id_to_image_pair(pair_id)
        matches = np.asarray(geometry.inlier_matches, dtype=np.int64).reshape(-1, 2)
        if len(matches) == 0 or first not in points or second not in points:
            continue
        a, b = points[first][matches[:, 0]], points[second][matches[:, 1]]
        both = (a >= 0) & (b >= 0)
        pairs.append((first, second))
        kept.append(int((both & (a == b)).sum()))
        broken.append(int((both & (a != b)).sum()))
    return PairInliers(
        np.array(pairs, dtype=np.int64).reshape(-1, 2),
        np.array(kept, dtype=np.int64),
        np.array(broken, dtype=np.int64),
    )


def find_false_pairs(votes: PairInliers) -> Int64[np.ndarray, "f 2"]:
    """Return the pairs that falsely join two different places that look alike; empty if there are none.

    Such a fold shows as a cut through the photographs with far more outlier than inlier matches across it.
    The cut starts from the eigenvector of the smallest eigenvalue of the Laplacian whose weights are inliers
    minus outliers, and is refined by moving single photographs.
    """
    numbers, index = np.unique(votes.pairs, return_inverse=True)
    if len(numbers) < 3:  # two photographs cannot be parted into two groups that see different places
        return votes.pairs[:0]
    a, b = index.reshape(-1, 2).T
    balance = (votes.inliers - votes.outliers).astype(np.float64)
    ends = (np.concatenate([a, b]), np.concatenate([b, a]))
    side = _min_cut(csr_array((np.tile(balance, 2), ends), shape=(len(numbers), len(numbers))))
    across = side[a] != side[b]
    if (
        votes.inliers[across].sum() > _MAX_INLIER_SHARE_OF_FALSE_PAIR * votes.outliers[across].sum()
        or not votes.outliers[across].any()
    ):
        return votes.pairs[:0]
    matches = votes.inliers + votes.outliers
    found: Int64[np.ndarray, "f 2"] = votes.pairs[
        across & (votes.inliers > _MIN_INLIER_SHARE_OF_TRUE_PAIR * matches)
    ]
    return found


def remove_pairs(database: Path, pairs: Int64[np.ndarray, "f 2"]) -> None:
    """Remove pairs, with their matches, from a database that nobody else has open."""
    with pycolmap.Database.open(database) as target:
        for first, second in pairs.tolist():
            target.delete_two_view_geometry(first, second)
            target.delete_matches(first, second)


def _min_cut(weight: csr_array) -> Bool[np.ndarray, " n"]:
    """Return the sides of a cut with a small sum of weights across it.

    Args:
        weight: n x n and symmetric; only photographs that have a pair have one.
    """
    order = np.argsort(_lowest_eigenvector(weight), kind="stable")
    side = np.zeros(len(order), dtype=bool)
    best, cut = side.copy(), np.inf
    across = 0.0
    # the best cut along its order, then single moves
    for photograph in order[:-1].tolist():
        others, weights = _edges(weight, photograph)
        # only the photograph's own edges change sides; weights are whole numbers, so that sums are exact
        across += float(np.where(side[others], -weights, weights).sum())
        side[photograph] = True
        if across < cut:
            best, cut = side.copy(), across
    while True:
        side, across = _refine_cut(weight, best)
        if not across < cut:
            return best
        best, cut = side, across


def _lowest_eigenvector(weight: csr_array) -> Float64[np.ndarray, " n"]:
    """Return the Fiedler vector's analog for signed weights; zeros where it is not found in time.

    By the Lanczos iterations of ARPACK, as thousands of photographs have far fewer pairs than a matrix has
    elements.
    """
    count = weight.shape[0]
    laplacian = (diags_array(weight.sum(axis=1)) - weight).tocsr()
    start = np.random.Generator(np.random.PCG64(0)).standard_normal(count)
    try:
        _, vectors = eigsh(
            laplacian,
            k=1,
            which="SA",
            v0=start,
            ncv=min(count, _LANCZOS_VECTORS),
            maxiter=_MAX_LANCZOS_RESTARTS,
        )
    except ArpackNoConvergence:
        return np.zeros(count)
    return np.asarray(vectors[:, 0])


def _edges(weight: csr_array, photograph: int) -> tuple[Int64[np.ndarray, " e"], Float64[np.ndarray, " e"]]:
    """Return the photographs that one has pairs with, and the weights of these pairs."""
    own = slice(weight.indptr[photograph], weight.indptr[photograph + 1])
    return np.asarray(weight.indices[own], np.int64), weight.data[own]


def _refine_cut(weight: csr_array, side: Bool[np.ndarray, " n"]) -> tuple[Bool[np.ndarray, " n"], float]:
    """Return the best cut met while moving each photograph once, the most profitable one first.

    Kernighan and Lin, "An Efficient Heuristic Procedure for Partitioning Graphs" (1970), without swaps.
    """
    sign = np.where(side, 1.0, -1.0)
    total, balance = float(weight.sum()), float(sign.sum())
    pull = weight @ sign
    signed = float(sign @ pull)
    best, least = side, np.inf
    is_open = np.ones(len(sign), dtype=bool)
    profit = -sign * pull
    for _ in range(len(sign)):
        photograph = int(np.argmax(profit))
        signed -= 4 * sign[photograph] * pull[photograph]
        sign[photograph] = -sign[photograph]
        balance += 2 * sign[photograph]
        is_open[photograph] = False
        # only the moved photograph's edges have changed
        others, weights = _edges(weight, photograph)
        pull[others] += 2 * sign[photograph] * weights
        profit[others] = np.where(is_open[others], -sign[others] * pull[others], -np.inf)
        profit[photograph] = -np.inf
        across = (total - signed) / 4  # cut = (sum of all weights - sum of signed ones) / 4
        if across < least and abs(balance) < len(sign):  # both sides have photographs
            best, least = sign > 0, across
    return best, least
