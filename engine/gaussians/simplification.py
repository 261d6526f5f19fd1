"""Fewer Gaussians that look alike: neighbors are merged, two at a time, by the moments of their mixture.

A pair becomes the Gaussian with the mean and the covariance of both, weighted by opacity times area, and
flattened along its least extent (Runnalls, "Kullback-Leibler Approach to Gaussian Mixture Reduction",
https://doi.org/10.1109/TAES.2007.4383588, section 2); which pairs are merged is decided by what they lose.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import KDTree

from octasplat.engine.gaussians.channels import Channels
from octasplat.engine.gaussians.frames import quaternions_from_matrices
from octasplat.engine.gaussians.materials import (
    AMBIENT,
    DIFFUSE_INTERREFLECTION,
    MATERIAL_WIDTHS,
    is_material_known,
)
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians

NEIGHBORS = 8
"""Nearest Gaussians among which partners are looked for."""
MAX_SHARE_PER_ROUND = 0.3
"""Most of all Gaussians that are merged away in a round: the best pairs of many, rather than all pairs."""
MATCHING_PASSES = 3
"""Pairs whose cost is the least for both are taken; the others look again so many times."""
COLOR_WEIGHT = 20.0
"""Weight of a squared difference of colors against a relative growth of the area."""
THICKNESS_WEIGHT = 0.5
"""Likewise of the thickness that a merged pair would have, of its length."""
MASS_EXPONENT = 0.25
"""Exponent of opacity times area by which the cost of a pair is weighted: 0 thins everything alike."""
MAX_OPACITY = 0.995
"""Most opacity of a merged Gaussian; what is more becomes area."""
MIN_SCALE = 1e-9
_AVERAGED = (*MATERIAL_WIDTHS, AMBIENT, DIFFUSE_INTERREFLECTION)
PAIRS_PER_CHUNK = 1 << 18


def simplify(
    gaussians: FlatGaussians, count: int, on_round: Callable[[int], None] = lambda _count: None
) -> FlatGaussians:
    """Return ``count`` Gaussians that look about like the given ones; these if there are no more.

    The result does not depend on anything random.

    Args:
        gaussians: the scene.
        count: how many to leave, 1 at least.
        on_round: called with the number that are left, after each round; it may raise to stop.

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
    while len(gaussians) > count:
        wanted = min(len(gaussians) - count, max(1, int(MAX_SHARE_PER_ROUND * len(gaussians))))
        first, second = _choose_pairs(gaussians, wanted)
        gaussians = _merge_pairs(gaussians, first, second)
        on_round(len(gaussians))
    return gaussians


def _choose_pairs(
    gaussians: FlatGaussians, wanted: int
) -> tuple[Int64[np.ndarray, " p"], Int64[np.ndarray, " p"]]:
    """Return at most ``wanted`` pairs without a common member, 1 at least, those of least cost."""
    first, second = _neighbor_pairs(gaussians)
    moments = _Moments(gaussians)
    costs = np.concatenate(
        [
            moments.costs(first[at : at + PAIRS_PER_CHUNK], second[at : at + PAIRS_PER_CHUNK])
            for at in range(0, len(first), PAIRS_PER_CHUNK)
        ]
    )
    order = np.argsort(costs, kind="stable")
    first, second, costs = first[order], second[order], costs[order]
    chosen: list[Int64[np.ndarray, " k"]] = []
    is_free = np.ones(len(gaussians), np.bool_)
    rows = np.arange(len(first))
    for _ in range(MATCHING_PASSES):
        rows = rows[is_free[first[rows]] & is_free[second[rows]]]
        if len(rows) == 0:
            break
        best = np.full(len(gaussians), len(first))
        # the cheapest pair of each, as rows ascend by cost
        np.minimum.at(best, first[rows], rows)
        np.minimum.at(best, second[rows], rows)
        taken = rows[(best[first[rows]] == rows) & (best[second[rows]] == rows)]
        is_free[first[taken]] = is_free[second[taken]] = False
        chosen.append(taken)
    cheapest = np.sort(np.concatenate(chosen))[:wanted]
    return first[cheapest], second[cheapest]


def _neighbor_pairs(gaussians: FlatGaussians) -> tuple[Int64[np.ndarray, " p"], Int64[np.ndarray, " p"]]:
    """Return the pairs of nearest neighbors, each once, the smaller index first."""
    total = len(gaussians)
    count = min(NEIGHBORS + 1, total)
    near = KDTree(gaussians.means_world).query(gaussians.means_world, k=count)[1].reshape(total, count)
    here = np.broadcast_to(np.arange(total)[:, None], near.shape)
    low, high = np.minimum(here, near).ravel(), np.maximum(here, near).ravel()
    keys = np.unique((low.astype(np.int64) * total + high)[low != high])
    return keys // total, keys % total


class _Moments:
    """Masses, means, covariances and colors of Gaussians, and what merging pairs of them costs."""

    def __init__(self, gaussians: FlatGaussians) -> None:
        scales = np.maximum(gaussians.scales.astype(np.float64), MIN_SCALE)
        axes = gaussians.rotations[:, :, 1:].astype(np.float64) * scales[:, None, :]
        self.areas = scales.prod(axis=1)
        self.masses = np.maximum(gaussians.opacities.astype(np.float64), 1e-6) * self.areas
        self.means = gaussians.means_world.astype(np.float64)
        self.covariances = axes @ axes.transpose(0, 2, 1)
        self.rgb = 0.5 + SH_C0 * gaussians.sh[:, 0].astype(np.float64)

    def mixture(
        self, first: Int64[np.ndarray, " p"], second: Int64[np.ndarray, " p"]
    ) -> tuple[Float64[np.ndarray, " p"], Float64[np.ndarray, "p 3"], Float64[np.ndarray, "p 3 3"]]:
        """Return mass, mean and covariance of each pair."""
        mass = self.masses[first] + self.masses[second]
        share = (self.masses[first] / mass)[:, None]
        apart = self.means[second] - self.means[first]
        mean = self.means[first] + (1 - share) * apart
        spread = (share * (1 - share))[:, :, None] * apart[:, :, None] * apart[:, None, :]
        within = _mean(self.covariances, first, second, share[:, :, None])
        return mass, mean, within + spread

    def costs(
        self, first: Int64[np.ndarray, " p"], second: Int64[np.ndarray, " p"]
    ) -> Float64[np.ndarray, " p"]:
        """Return what merging each pair loses: area and thickness that it gains, and difference of colors."""
        mass, _, covariance = self.mixture(first, second)
        thin, middle, long = np.maximum(np.linalg.eigvalsh(covariance), MIN_SCALE**2).T
        area = np.sqrt(middle * long)
        share = self.masses[first] / mass
        before = share * self.areas[first] + (1 - share) * self.areas[second]
        color = ((self.rgb[first] - self.rgb[second]) ** 2).sum(axis=1) * share * (1 - share)
        loss = area / before - 1 + THICKNESS_WEIGHT * np.sqrt(thin / long) + COLOR_WEIGHT * color
        result: np.ndarray = loss * mass**MASS_EXPONENT
        return result


def _merge_pairs(
    gaussians: FlatGaussians, first: Int64[np.ndarray, " p"], second: Int64[np.ndarray, " p"]
) -> FlatGaussians:
    """Return the Gaussians with each pair merged, in the place of its first."""
    moments = _Moments(gaussians)
    mass, mean, covariance = moments.mixture(first, second)
    values, vectors = np.linalg.eigh(covariance)
    scales = np.sqrt(np.maximum(values[:, 1:], MIN_SCALE**2))
    opacity = mass / scales.prod(axis=1)
    # what two hide beside each other does not fit under one peak
    scales *= np.sqrt(np.maximum(opacity / MAX_OPACITY, 1.0))[:, None]
    opacity = np.minimum(opacity, MAX_OPACITY)
    share = (moments.masses[first] / mass)[:, None]
    normals = gaussians.rotations[:, :, 0].astype(np.float64)
    facing = share * normals[first] + (1 - share) * _turned_to(normals[second], normals[first])
    normal = _turned_to(vectors[:, :, 0], facing)
    frames = np.stack([normal, vectors[:, :, 1], np.cross(normal, vectors[:, :, 1])], axis=2)
    merged = FlatGaussians(
        means_world=mean.astype(np.float32),
        quats_wxyz=quaternions_from_matrices(frames).astype(np.float32),
        log_scales=np.log(scales).astype(np.float32),
        opacity_logits=np.log(opacity / (1 - opacity)).astype(np.float32),
        sh=_mean(gaussians.sh, first, second, share[:, :, None]).astype(np.float32),
        channels=_merged_channels(gaussians, first, second, share),
    )
    result = gaussians.copy()
    result.put(first, merged)
    is_left = np.ones(len(gaussians), np.bool_)
    is_left[second] = False
    return result.select(is_left)


def _turned_to(vectors: Float64[np.ndarray, "p 3"], others: Float64[np.ndarray, "p 3"]) -> np.ndarray:
    """Return vectors on the side of others."""
    return np.where((vectors * others).sum(axis=1, keepdims=True) < 0, -vectors, vectors)


def _mean(
    values: np.ndarray, first: Int64[np.ndarray, " p"], second: Int64[np.ndarray, " p"], share: np.ndarray
) -> np.ndarray:
    """Return the mean of pairs of values, of which the first has a share."""
    result: np.ndarray = share * values[first] + (1 - share) * values[second]
    return result


def _merged_channels(
    gaussians: FlatGaussians,
    first: Int64[np.ndarray, " p"],
    second: Int64[np.ndarray, " p"],
    share: Float64[np.ndarray, "p 1"],
) -> Channels:
    """Return the channels of merged pairs: means of what can have one, else those of the larger.

    A material that one of a pair does not know is the other's.
    """
    known: Bool[np.ndarray, " n"] = is_material_known(gaussians)
    of_known = np.where(known[first] & ~known[second], 1.0, share[:, 0])
    of_known = np.where(known[second] & ~known[first], 0.0, of_known)[:, None]
    larger = np.where(share >= 0.5, 1.0, 0.0)  # a label has no mean
    return Channels(
        {
            name: _mean(array, first, second, of_known if name in _AVERAGED else larger).astype(np.float32)
            for name, array in gaussians.channels.items()
        }
    )
