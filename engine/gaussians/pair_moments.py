"""Moments of pairs of Gaussians: what merging a pair loses, and what comes of it.

A pair becomes the Gaussian with the mean and the covariance of both, weighted by opacity times area, and
flattened along its least extent (Runnalls, "Kullback-Leibler Approach to Gaussian Mixture Reduction",
https://doi.org/10.1109/TAES.2007.4383588, section 2). Its opacity times area is the integral of the alpha of
both, composited as by a ray along its normal: where they overlap, that is less than their sum.
"""

import numpy as np
from jaxtyping import Bool, Float64, Int

from octasplat.engine.gaussians.channels import Channels
from octasplat.engine.gaussians.frames import quaternions_from_matrices
from octasplat.engine.gaussians.materials import (
    AMBIENT,
    DIFFUSE_INTERREFLECTION,
    MATERIAL_WIDTHS,
    is_material_known,
)
from octasplat.engine.gaussians.model import MAX_LOG_SCALE, SH_C0, FlatGaussians

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


def pair_costs(
    gaussians: FlatGaussians, first: Int[np.ndarray, " p"], second: Int[np.ndarray, " p"]
) -> Float64[np.ndarray, " p"]:
    """Return what merging each pair loses; infinite where that has no number.

    Args:
        gaussians: the scene, of which only the pairs are looked at.
        first: row of one of each pair.
        second: row of the other.
    """
    rows, places = np.unique(np.concatenate([first, second]), return_inverse=True)
    costs = _Moments(gaussians.with_base_color_only().select(rows)).costs(
        places[: len(first)], places[len(first) :]
    )
    costs[np.isnan(costs)] = np.inf
    return costs


def merged_pairs(
    gaussians: FlatGaussians, first: Int[np.ndarray, " p"], second: Int[np.ndarray, " p"]
) -> FlatGaussians:
    """Return the Gaussians that pairs become; see :func:`pair_costs` for the arguments."""
    some = gaussians.select(np.concatenate([first, second]))
    count = len(first)
    return _merge(some, np.arange(count), np.arange(count, 2 * count))


class _Moments:
    """Masses, means, covariances and colors of Gaussians, and what merging pairs of them costs."""

    def __init__(self, gaussians: FlatGaussians) -> None:
        # larger ones count as the largest that float32 holds
        scales = np.exp(np.minimum(gaussians.log_scales, np.float32(MAX_LOG_SCALE)))
        scales = np.maximum(scales.astype(np.float64), MIN_SCALE)
        axes = gaussians.rotations[:, :, 1:].astype(np.float64) * scales[:, None, :]
        self.areas = scales.prod(axis=1)
        self.masses = np.maximum(gaussians.opacities.astype(np.float64), 1e-6) * self.areas
        self.means = gaussians.means_world.astype(np.float64)
        self.covariances = axes @ axes.transpose(0, 2, 1)
        self.rgb = 0.5 + SH_C0 * gaussians.sh[:, 0].astype(np.float64)

    def mixture(
        self, first: Int[np.ndarray, " p"], second: Int[np.ndarray, " p"]
    ) -> tuple[Float64[np.ndarray, " p"], Float64[np.ndarray, "p 3"], Float64[np.ndarray, "p 3 3"]]:
        """Return mass, mean and covariance of each pair."""
        mass = self.masses[first] + self.masses[second]
        share = (self.masses[first] / mass)[:, None]
        apart = self.means[second] - self.means[first]
        mean = self.means[first] + (1 - share) * apart
        spread = (share * (1 - share))[:, :, None] * apart[:, :, None] * apart[:, None, :]
        within = _mean(self.covariances, first, second, share[:, :, None])
        return mass, mean, within + spread

    def overlap(
        self,
        first: Int[np.ndarray, " p"],
        second: Int[np.ndarray, " p"],
        planes: Float64[np.ndarray, "p 3 2"],
    ) -> Float64[np.ndarray, " p"]:
        """Return by how much the sum of the masses of each pair exceeds the mass of both together.

        Alphas a and b composite to a + b - a b. The last term is a product of Gaussians, whose integral over
        a plane has a closed form.

        Args:
            first: row of one of each pair.
            second: row of the other.
            planes: axes, of unit length and orthogonal, in which they are looked at.
        """
        across = planes.transpose(0, 2, 1)
        one, other = (across @ self.covariances[rows] @ planes for rows in (first, second))
        both = one + other
        x, y = (across @ (self.means[second] - self.means[first])[:, :, None])[:, :, 0].T
        opacity = (self.masses[first] / self.areas[first]) * (self.masses[second] / self.areas[second])
        # what is seen from its edge in both has no area
        det = np.maximum(_determinant(both), np.finfo(np.float64).tiny)
        squared = both[:, 1, 1] * x * x - 2.0 * both[:, 0, 1] * x * y + both[:, 0, 0] * y * y
        area = np.sqrt(_determinant(one) / det) * np.sqrt(_determinant(other))
        result = opacity * area * np.exp(-0.5 * np.maximum(squared, 0.0) / det)
        return np.asarray(np.minimum(result, np.minimum(self.masses[first], self.masses[second])))

    def costs(self, first: Int[np.ndarray, " p"], second: Int[np.ndarray, " p"]) -> Float64[np.ndarray, " p"]:
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


def _merge(
    gaussians: FlatGaussians, first: Int[np.ndarray, " p"], second: Int[np.ndarray, " p"]
) -> FlatGaussians:
    """Return what each pair becomes."""
    moments = _Moments(gaussians)
    mass, mean, covariance = moments.mixture(first, second)
    values, vectors = np.linalg.eigh(covariance)
    scales = np.sqrt(np.maximum(values[:, 1:], MIN_SCALE**2))
    opacity = (mass - moments.overlap(first, second, vectors[:, :, 1:])) / scales.prod(axis=1)
    # what two hide beside each other does not fit under one peak
    scales *= np.sqrt(np.maximum(opacity / MAX_OPACITY, 1.0))[:, None]
    opacity = np.minimum(opacity, MAX_OPACITY)
    share = (moments.masses[first] / mass)[:, None]
    normals = gaussians.rotations[:, :, 0].astype(np.float64)
    facing = share * normals[first] + (1 - share) * _turned_to(normals[second], normals[first])
    normal = _turned_to(vectors[:, :, 0], facing)
    frames = np.stack([normal, vectors[:, :, 1], np.cross(normal, vectors[:, :, 1])], axis=2)
    return FlatGaussians(
        means_world=mean.astype(np.float32),
        quats_wxyz=quaternions_from_matrices(frames).astype(np.float32),
        log_scales=np.minimum(np.log(scales), MAX_LOG_SCALE).astype(np.float32),
        opacity_logits=np.log(opacity / (1 - opacity)).astype(np.float32),
        sh=_mean(gaussians.sh, first, second, share[:, :, None]).astype(np.float32),
        channels=_merged_channels(gaussians, first, second, share),
    )


def _determinant(matrices: Float64[np.ndarray, "p 2 2"]) -> Float64[np.ndarray, " p"]:
    """Return determinants of symmetric matrices, which rounding does not make negative."""
    product = matrices[:, 0, 0] * matrices[:, 1, 1]
    return np.asarray(np.maximum(product - matrices[:, 0, 1] ** 2, 0.0))


def _turned_to(vectors: Float64[np.ndarray, "p 3"], others: Float64[np.ndarray, "p 3"]) -> np.ndarray:
    """Return vectors on the side of others."""
    return np.where((vectors * others).sum(axis=1, keepdims=True) < 0, -vectors, vectors)


def _mean(
    values: np.ndarray, first: Int[np.ndarray, " p"], second: Int[np.ndarray, " p"], share: np.ndarray
) -> np.ndarray:
    """Return the mean of pairs of values, of which the first has a share."""
    result: np.ndarray = share * values[first] + (1 - share) * values[second]
    return result


def _merged_channels(
    gaussians: FlatGaussians,
    first: Int[np.ndarray, " p"],
    second: Int[np.ndarray, " p"],
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
