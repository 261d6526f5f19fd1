"""Gradients of traced outputs with respect to the rays, in closed form from recorded hits.

A ray o + t d meets the plane of a Gaussian with mean m and normal r1 at t = <m - o, r1> / <d, r1>. The hit
p = o + t d moves with o and d directly and through t, with dt/do = -r1 / <d, r1> and dt/dd = t dt/do. So the
gradient by d is t times that by o, but for the direction in which the Gaussian's color is seen.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.spherical_harmonics import sh_basis, sh_basis_gradients
from octasplat.engine.trace.protocol import Recording, TraceGradients, TraceSettings
from octasplat.engine.trace.ray_hits import RayHits, batched_ray_hits


@dataclass(frozen=True)
class RayGradients:
    """Gradients of a loss by rays, one row per ray, also if all rays share one origin."""

    origins_world: Float32[np.ndarray, "r 3"]
    directions_world: Float32[np.ndarray, "r 3"]


def ray_gradients(
    gaussians: FlatGaussians,
    rays: RayBatch,
    recording: Recording,
    gradients: TraceGradients,
    settings: TraceSettings,
    features: Float32[np.ndarray, "n f"] | None = None,
) -> RayGradients:
    """Return the gradients of a loss with respect to the origins and directions of recorded rays.

    As for the parameters, there is none through the edges of octagons, visibility, or the limits of rays.

    Args:
        gaussians: with the parameters that the recording was made with.
        rays: those of the recording.
        recording: which Gaussians each ray met.
        gradients: of the loss by the outputs of the trace.
        settings: of its tracer.
        features: those that the tracer was built with.
    """
    origins, directions = np.zeros((len(rays), 3), np.float32), np.zeros((len(rays), 3), np.float32)
    for part, hits in batched_ray_hits(gaussians, rays, recording, settings):
        given = _OutputGradients.from_slice(gradients, part)
        grad_origin, grad_direction = _hit_gradients(
            gaussians=gaussians,
            rays=rays[part],
            hits=hits,
            output_gradients=given,
            settings=settings,
            features=features,
        )
        for axis in range(3):
            origins[part, axis] = hits.sums_per_ray(grad_origin[:, axis])
            directions[part, axis] = hits.sums_per_ray(grad_direction[:, axis])
    return RayGradients(origins, directions)


@dataclass(frozen=True)
class _OutputGradients:
    """Gradients by the outputs of some rays, zero where nothing was given."""

    rgb: Float64[np.ndarray, "r 3"]
    transmittance: Float64[np.ndarray, " r"]
    depth_sum: Float64[np.ndarray, " r"]
    depth_median: Float64[np.ndarray, " r"]
    normal: Float64[np.ndarray, "r 3"]
    features: Float64[np.ndarray, "r f"] | None

    @classmethod
    def from_slice(cls, gradients: TraceGradients, ray_slice: slice) -> "_OutputGradients":
        rgb = gradients.rgb_srgb[ray_slice].astype(np.float64)

        def scalar(values: np.ndarray | None) -> Float64[np.ndarray, " r"]:
            return np.zeros(len(rgb)) if values is None else values[ray_slice].astype(np.float64)

        normal, features = gradients.normal_world, gradients.features
        return cls(
            rgb,
            scalar(gradients.transmittance),
            scalar(gradients.depth_sum),
            scalar(gradients.depth_median),
            np.zeros_like(rgb) if normal is None else normal[ray_slice].astype(np.float64),
            None if features is None else features[ray_slice].astype(np.float64),
        )


def _hit_gradients(
    gaussians: FlatGaussians,
    rays: RayBatch,
    hits: RayHits,
    output_gradients: _OutputGradients,
    settings: TraceSettings,
    features: Float32[np.ndarray, "n f"] | None,
) -> tuple[Float64[np.ndarray, "h 3"], Float64[np.ndarray, "h 3"]]:
    """Return each hit's share of the gradients with respect to the origin and direction of its ray."""
    ray, ids = hits.ray_ids, hits.ids
    directions = rays.directions_world.astype(np.float64)[ray]
    normals, weight = hits.frames[:, :, 0], hits.weight

    # --- color, and the direction in which it is seen ---
    t_view_origins = np.broadcast_to(rays.t_view_origin, len(rays)).astype(np.float64)[ray]
    has_viewer = np.isfinite(t_view_origins)
    # no use of an infinite one, but 0 times infinity would be not-a-number
    t_view_origin = np.where(has_viewer, t_view_origins, 0.0)[:, None]
    view = np.where(has_viewer[:, None], hits.to_mean - t_view_origin * directions, directions)
    length = np.linalg.norm(view, axis=1, keepdims=True)
    # a Gaussian right at the viewer is seen in no direction, as in the kernels, and has no gradient by it
    view = np.divide(view, length, out=np.zeros_like(view), where=length > 0)
    sh = gaussians.sh[ids].astype(np.float64)
    color = 0.5 + np.einsum("hk,hkc->hc", sh_basis(view, gaussians.sh_degree), sh)
    # a channel clamped at zero has no gradient
    grad_color = np.where(color > 0, weight[:, None] * output_gradients.rgb[ray], 0.0)
    grad_unit_view = np.einsum(
        "hki,hkc,hc->hi", sh_basis_gradients(view, gaussians.sh_degree), sh, grad_color
    )
    across = grad_unit_view - (grad_unit_view * view).sum(axis=1, keepdims=True) * view
    grad_view = np.divide(across, length, out=np.zeros_like(view), where=length > 0)

    # --- the gradient with respect to the hit's weight: what it brings for each unit of that ---
    cosine_to_mean = np.einsum("hi,hi->h", hits.to_mean, normals) / np.linalg.norm(hits.to_mean, axis=1)
    facing = np.where(cosine_to_mean > settings.flip_normal_cos, -1.0, 1.0)
    grad_weight = np.einsum("hc,hc->h", np.maximum(color, 0), output_gradients.rgb[ray])
    grad_weight += hits.t * output_gradients.depth_sum[ray]
    grad_weight += facing * np.einsum("hi,hi->h", normals, output_gradients.normal[ray])
    if features is not None and output_gradients.features is not None:
        grad_weight += np.einsum("hf,hf->h", features[ids].astype(np.float64), output_gradients.features[ray])

    # --- alpha: what it adds here, less what it hides behind ---
    weighted_gradient = weight * grad_weight
    behind = (
        hits.sums_per_ray(weighted_gradient)[ray] - hits.sums_in_front(weighted_gradient) - weighted_gradient
    )
    final_transmittance = np.exp(hits.sums_per_ray(np.log1p(-hits.alpha)))[ray]
    grad_alpha = hits.transmittance * grad_weight - (
        behind + final_transmittance * output_gradients.transmittance[ray]
    ) / (1 - hits.alpha)
    grad_uv = np.where(hits.is_clamped, 0.0, -grad_alpha * hits.alpha)[:, None] * hits.uv

    # --- the hit in its plane, and its distance ---
    grad_hit = np.einsum("hik,hk->hi", hits.frames[:, :, 1:], grad_uv / hits.scales)
    is_median = (hits.transmittance > 0.5) & (hits.transmittance * (1 - hits.alpha) <= 0.5)
    grad_t = weight * output_gradients.depth_sum[ray] + np.where(
        is_median, output_gradients.depth_median[ray], 0.0
    )
    grad_t += np.einsum("hi,hi->h", grad_hit, directions)
    # dt/do = -r1 / <d, r1>, and the gradient by d is t times that by o
    grad_position = grad_hit - (grad_t / hits.cosine)[:, None] * normals
    grad_origin = grad_position - np.where(has_viewer[:, None], grad_view, 0.0)
    grad_direction = hits.t[:, None] * grad_position
    grad_direction += np.where(has_viewer[:, None], -t_view_origin * grad_view, grad_view)
    return grad_origin, grad_direction
