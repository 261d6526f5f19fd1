"""Rays that show two surfaces, one behind the edge of the other, parted so that each is shaded by itself.

The photograph of an edge is the mean of two colors. Materials and normals that are blended over both
surfaces first and shaded then belong to neither. Where the mean depth of a ray lies far from its median, the
ray is traced once more as far as the mean, which lies between two surfaces wherever these are. That is the
front; what the whole ray saw beyond it is the back, as all that is blended is a sum over the ray.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64, Shaped

from octasplat.engine.core.rays import RayBatch, concatenate_rays
from octasplat.engine.trace.protocol import Recording, TraceGradients, Tracer, TraceResult

MIN_FRACTION = 0.05
"""Of the light of a ray that each of two surfaces takes at least."""


@dataclass(frozen=True)
class DepthLayers:
    """Depth layers of rays, each one surface: ``l`` parts of ``r`` rays.

    The first ``r`` parts are the rays as they were, those of ``split_ids`` without their front; then come the
    fronts. The transmittance of a part is one minus what it adds to the ray's accumulated alpha.

    Attributes:
        rays: of the parts.
        results: by each part alone.
        split_ids: numbers of the rays that show two surfaces.
        front: recording of what was traced for the fronts; None if nothing was, or nothing is recorded.
        traced: which of that are fronts; the others turned out to show one surface.
    """

    rays: RayBatch
    results: TraceResult
    split_ids: Int64[np.ndarray, " f"]
    front: Recording | None = None
    traced: Bool[np.ndarray, " t"] = field(default_factory=lambda: np.zeros(0, bool))

    def sum_layers(self, values: Float[np.ndarray, "l c"]) -> Float[np.ndarray, "r c"]:
        """Return the sums over the layers of each ray."""
        count = len(values) - len(self.split_ids)
        out = values[:count].copy()
        out[self.split_ids] += values[count:]
        return out

    def ray_means(
        self,
        layer_ids: Int64[np.ndarray, " p"],
        alpha: Float64[np.ndarray, " p"],
        values: Mapping[str, Float64[np.ndarray, "p _"]],
    ) -> dict[str, Float32[np.ndarray, "r _"]]:
        """Return by name the means, weighted by alpha, of values at the points of layers ``layer_ids``."""
        count = len(self.rays)
        weights = np.zeros((count, 1))
        weights[layer_ids] = alpha[:, None]
        weights /= np.maximum(self.expand(self.sum_layers(weights)), 1e-12)
        means = {}
        for name, at_points in values.items():
            at_layers = np.zeros((count, at_points.shape[1]))
            at_layers[layer_ids] = at_points
            means[name] = self.sum_layers(weights * at_layers).astype(np.float32)
        return means

    def expand(self, values: Shaped[np.ndarray, "r *c"]) -> Shaped[np.ndarray, "l *c"]:
        """Return the value of its ray for each layer."""
        return np.concatenate([values, values[self.split_ids]]) if len(self.split_ids) else values

    def backward(
        self, grad_layers: TraceGradients
    ) -> tuple[TraceGradients, tuple[tuple[Recording, TraceGradients], ...]]:
        """Return gradients by the whole rays and by the fronts, from those by the layers."""
        if not len(self.split_ids):
            return grad_layers, ()
        count = len(grad_layers.rgb_srgb) - len(self.split_ids)
        of_rays, of_fronts = {}, {}
        for name in (entry.name for entry in fields(TraceGradients)):
            value = getattr(grad_layers, name)
            if value is not None:
                of_rays[name] = value[:count]
                of_fronts[name] = np.zeros((len(self.traced), *value.shape[1:]), value.dtype)
                # the whole ray is the back: what the front has is subtracted there
                of_fronts[name][self.traced] = value[count:] - value[self.split_ids]
        fronts = () if self.front is None else ((self.front, TraceGradients(**of_fronts)),)
        return TraceGradients(**of_rays), fronts


def single_layer(rays: RayBatch, result: TraceResult) -> DepthLayers:
    """Return rays as one depth layer each, none of them split."""
    return DepthLayers(rays, result, np.empty(0, np.int64))


def split_by_depth(
    rays: RayBatch,
    result: TraceResult,
    tracer: Tracer,
    *,
    min_separation_world: float,
    record_for_backward: bool,
) -> DepthLayers:
    """Split the rays whose mean depth is farther than ``min_separation_world`` from the median.

    Args:
        rays: with unit directions.
        result: along them.
        tracer: that traced them.
        min_separation_world: distance between mean and median depth, world units.
        record_for_backward: whether to keep what the backward pass needs.
    """
    mean = result.expected_depth
    far = (np.abs(mean - result.depth_median) > min_separation_world) & (result.depth_median > 0)
    split_ids = np.flatnonzero(far)
    if not len(split_ids):
        return single_layer(rays, result)
    # not beyond the ray's own end
    ends = np.minimum(np.broadcast_to(rays.t_max, len(rays))[split_ids], mean[split_ids])
    front_rays = rays[split_ids].with_t_max(ends)
    front = tracer.trace(front_rays, record=record_for_backward)
    is_split = (front.alpha > MIN_FRACTION) & (result.alpha[split_ids] - front.alpha > MIN_FRACTION)
    split_ids = split_ids[is_split]
    if not len(split_ids):
        return single_layer(rays, result)

    def divided(sums: Float32[np.ndarray, "r *c"], ahead: Float32[np.ndarray, "t *c"]) -> np.ndarray:
        back = sums.copy()
        back[split_ids] -= ahead[is_split]
        return np.concatenate([back, ahead[is_split]])

    def listed(values: Shaped[np.ndarray, " r"], ahead: Shaped[np.ndarray, " t"]) -> np.ndarray:
        return np.concatenate([values, ahead[is_split]])

    parts = TraceResult(
        rgb_srgb=divided(result.rgb_srgb, front.rgb_srgb),
        transmittance=1 - divided(result.alpha, front.alpha),
        depth_sum=divided(result.depth_sum, front.depth_sum),
        depth_median=listed(result.depth_median, front.depth_median),
        normal_world=divided(result.normal_world, front.normal_world),
        features=divided(result.features, front.features),
        hit_counts=listed(result.hit_counts, front.hit_counts),
    )
    return DepthLayers(
        concatenate_rays(rays, front_rays[is_split]), parts, split_ids, front.recording, is_split
    )
