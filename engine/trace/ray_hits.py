"""Recorded hits as flat arrays, evaluated again in float64: one row per ray and Gaussian."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.frames import rotation_matrices
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.protocol import Recording, TraceSettings

HITS_PER_BATCH = 1 << 18
"""Rows of one piece; each takes about a kilobyte while gradients are computed."""


@dataclass(frozen=True)
class RayHits:
    """``h`` hits of ``r`` rays, ray by ray and front to back; symbols as in the reference implementation.

    Attributes:
        counts: hits of each ray.
        ray_ids: number of each hit's ray.
        ids: number of each hit's Gaussian.
        to_mean: from the ray's origin to the mean.
        frames: rotation matrices; columns are the normal and the in-plane axes.
        scales: standard deviations along the in-plane axes.
        cosine: of the direction to the normal, where the direction has unit length.
        t: distance of the hit.
        uv: the hit in standard deviations.
        alpha: opacity at the hit.
        is_clamped: whether alpha is at its upper limit.
        transmittance: transmittance in front of the hit.
    """

    counts: Int64[np.ndarray, " r"]
    ray_ids: Int64[np.ndarray, " h"]
    ids: Int64[np.ndarray, " h"]
    to_mean: Float64[np.ndarray, "h 3"]
    frames: Float64[np.ndarray, "h 3 3"]
    scales: Float64[np.ndarray, "h 2"]
    cosine: Float64[np.ndarray, " h"]
    t: Float64[np.ndarray, " h"]
    uv: Float64[np.ndarray, "h 2"]
    alpha: Float64[np.ndarray, " h"]
    is_clamped: Bool[np.ndarray, " h"]
    transmittance: Float64[np.ndarray, " h"]

    @property
    def weight(self) -> Float64[np.ndarray, " h"]:
        """Return the blending weight of each hit, alpha T."""
        return self.alpha * self.transmittance

    def sums_in_front(self, values: Float64[np.ndarray, " h"]) -> Float64[np.ndarray, " h"]:
        """Return the sum of ``values`` over the hits in front of each hit on its ray."""
        return _segmented_exclusive_cumsum(values, self.counts)

    def sums_per_ray(self, values: Float64[np.ndarray, " h"]) -> Float64[np.ndarray, " r"]:
        """Return the sum of ``values`` over each ray."""
        return np.bincount(self.ray_ids, values, minlength=len(self.counts))


def batched_ray_hits(
    gaussians: FlatGaussians, rays: RayBatch, recording: Recording, settings: TraceSettings
) -> Iterator[tuple[slice, RayHits]]:
    """Yield the hits of consecutive rays with the rays' slice, in batches of bounded memory.

    Args:
        gaussians: with the parameters that the recording was made with.
        rays: those of the recording.
        recording: which Gaussians each ray met.
        settings: of its tracer.
    """
    counts, ids = recording.ids_by_ray()
    ends = np.cumsum(counts, dtype=np.int64)
    first = 0
    while first < len(rays):
        begin = int(ends[first - 1]) if first else 0
        # one ray at least, however many hits it has
        last = max(first + 1, int(np.searchsorted(ends, begin + HITS_PER_BATCH, side="right")))
        end = int(ends[last - 1])
        part = slice(first, last)
        yield part, _evaluate_hits(gaussians, rays[part], counts[part], ids[begin:end], settings)
        first = last


@dataclass(frozen=True)
class BlendWeights:
    """Weights of the Gaussians along rays.

    Attributes:
        counts: hits of each ray.
        ids: number of each hit's Gaussian, ray by ray and front to back.
        weights: alpha T of each hit.
    """

    counts: Int64[np.ndarray, " r"]
    ids: Int32[np.ndarray, " h"]
    weights: Float64[np.ndarray, " h"]


def blend_weights(
    gaussians: FlatGaussians, rays: RayBatch, recording: Recording, settings: TraceSettings
) -> BlendWeights:
    """Return the weights with which the Gaussians are blended along rays.

    They are read from the recording where it keeps opacities, and computed again elsewhere. The arguments are
    those of :func:`batched_ray_hits`.
    """
    counts, ids = recording.ids_by_ray()
    wide = counts.astype(np.int64)
    if (alphas := recording.alphas_by_ray()) is not None:
        alpha = alphas.astype(np.float64)
        return BlendWeights(wide, ids, alpha * np.exp(_segmented_exclusive_cumsum(np.log1p(-alpha), wide)))
    parts = [hits.weight for _, hits in batched_ray_hits(gaussians, rays, recording, settings)]
    return BlendWeights(wide, ids, np.concatenate([np.empty(0), *parts]))


def dominant_gaussians(
    gaussians: FlatGaussians, rays: RayBatch, recording: Recording, settings: TraceSettings
) -> Int32[np.ndarray, " r"]:
    """Return the Gaussian with the largest weight on each ray, -1 where it hit none.

    Of equal weights the one in front counts. The arguments are those of :func:`batched_ray_hits`.
    """
    heaviest = np.full(len(rays), -1, np.int32)
    for part, hits in batched_ray_hits(gaussians, rays, recording, settings):
        order = np.lexsort((-hits.weight, hits.ray_ids))  # stable: of equal ones the front one stays first
        met = np.flatnonzero(hits.counts)
        firsts = (np.cumsum(hits.counts) - hits.counts)[met]
        heaviest[part][met] = hits.ids[order[firsts]]
    return heaviest


def _evaluate_hits(
    gaussians: FlatGaussians,
    rays: RayBatch,
    counts: Int32[np.ndarray, " r"],
    ids: Int32[np.ndarray, " h"],
    settings: TraceSettings,
) -> RayHits:
    ray, numbers = np.repeat(np.arange(len(counts)), counts), ids.astype(np.int64)
    directions = rays.directions_world.astype(np.float64)[ray]
    origins = np.broadcast_to(rays.origins_world, rays.directions_world.shape).astype(np.float64)[ray]
    frames = rotation_matrices(gaussians.quats_wxyz[numbers].astype(np.float64))
    scales = np.exp(gaussians.log_scales[numbers].astype(np.float64))
    to_mean = gaussians.means_world[numbers].astype(np.float64) - origins
    cosine = np.einsum("hi,hi->h", directions, frames[:, :, 0])
    t = np.einsum("hi,hi->h", to_mean, frames[:, :, 0]) / cosine
    offset = t[:, None] * directions - to_mean
    uv = np.einsum("hi,hik->hk", offset, frames[:, :, 1:]) / scales
    opacities = 1 / (1 + np.exp(-gaussians.opacity_logits[numbers].astype(np.float64)))
    alpha = opacities * np.exp(-0.5 * (uv * uv).sum(axis=1))
    clamped = alpha > settings.alpha_max
    alpha = np.minimum(alpha, settings.alpha_max)
    wide = counts.astype(np.int64)
    # products along rays as sums of logarithms: one running sum for all
    transmittance = np.exp(_segmented_exclusive_cumsum(np.log1p(-alpha), wide))
    return RayHits(
        counts=wide,
        ray_ids=ray,
        ids=numbers,
        to_mean=to_mean,
        frames=frames,
        scales=scales,
        cosine=cosine,
        t=t,
        uv=uv,
        alpha=alpha,
        is_clamped=clamped,
        transmittance=transmittance,
    )


def _segmented_exclusive_cumsum(
    values: Float64[np.ndarray, " h"], counts: Int64[np.ndarray, " r"]
) -> Float64[np.ndarray, " h"]:
    total = np.concatenate([[0.0], np.cumsum(values)])
    firsts = np.cumsum(counts) - counts
    return np.asarray(total[:-1] - np.repeat(total[firsts], counts))
