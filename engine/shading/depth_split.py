"""Rays that show two surfaces, one behind the edge of the other, parted so that each is shaded by itself.

The photograph of an edge is the mean of two colours. Materials and normals that are blended over both
surfaces first and shaded then belong to neither. Where the mean depth of a ray lies far from its median, the
ray is traced once more as far as the mean, which lies between two surfaces wherever these are. That is the
front; what the whole ray saw beyond it is the back, as all that is blended is a sum over the ray.
"""

from dataclasses import dataclass, field, fields

import numpy as np
from jaxtyping import Bool, Float, Float32, Int64, Shaped

from octasplat.engine.core.rays import RayBatch, joined
from octasplat.engine.trace.protocol import Recording, TraceGradients, Tracer, TraceResult

LEAST_SHARE = 0.05
"""Of the light of a ray that each of two surfaces takes at least."""


@dataclass(frozen=True)
class Parted:
    """What rays show, one surface at a time: ``l`` parts of ``r`` rays.

    The first ``r`` parts are the rays as they were, those of ``two`` without their front; then come the
    fronts. The transmittance of a part is one minus what it adds to the ray's accumulated alpha.

    Attributes:
        rays: of the parts.
        seen: by each part alone.
        two: numbers of the rays that show two surfaces.
        front: recording of what was traced for the fronts; None if nothing was, or nothing is recorded.
        traced: which of that are fronts; the others turned out to show one surface.
    """

    rays: RayBatch
    seen: TraceResult
    two: Int64[np.ndarray, " f"]
    front: Recording | None = None
    traced: Bool[np.ndarray, " t"] = field(default_factory=lambda: np.zeros(0, bool))

    def joined(self, values: Float[np.ndarray, "l c"]) -> Float[np.ndarray, "r c"]:
        """Sums over the parts of each ray."""
        count = len(values) - len(self.two)
        out = values[:count].copy()
        out[self.two] += values[count:]
        return out

    def each(self, values: Shaped[np.ndarray, "r *c"]) -> Shaped[np.ndarray, "l *c"]:
        """The value of its ray for each part."""
        return np.concatenate([values, values[self.two]]) if len(self.two) else values

    def back(
        self, by_parts: TraceGradients
    ) -> tuple[TraceGradients, tuple[tuple[Recording, TraceGradients], ...]]:
        """Gradients by the whole rays and by the fronts, from those by the parts."""
        if not len(self.two):
            return by_parts, ()
        count = len(by_parts.rgb_srgb) - len(self.two)
        of_rays, of_fronts = {}, {}
        for name in (entry.name for entry in fields(TraceGradients)):
            value = getattr(by_parts, name)
            if value is not None:
                of_rays[name] = value[:count]
                of_fronts[name] = np.zeros((len(self.traced), *value.shape[1:]), value.dtype)
                of_fronts[name][self.traced] = value[count:] - value[self.two]
        fronts = () if self.front is None else ((self.front, TraceGradients(**of_fronts)),)
        return TraceGradients(**of_rays), fronts


def whole(rays: RayBatch, seen: TraceResult) -> Parted:
    """Rays as they are."""
    return Parted(rays, seen, np.empty(0, np.int64))


def part(rays: RayBatch, seen: TraceResult, tracer: Tracer, *, apart_world: float, record: bool) -> Parted:
    """Part the rays whose mean depth is farther than ``apart_world`` from the median.

    Args:
        rays: with unit directions.
        seen: along them.
        tracer: that saw it.
        apart_world: see there.
        record: whether there will be a way back.
    """
    mean = seen.expected_depth
    far = (np.abs(mean - seen.depth_median) > apart_world) & (seen.depth_median > 0)
    two = np.flatnonzero(far)
    if not len(two):
        return whole(rays, seen)
    ends = np.minimum(np.broadcast_to(rays.t_max, len(rays))[two], mean[two])
    front_rays = rays[two].up_to(ends)
    front = tracer.trace(front_rays, record=record)
    kept = (front.alpha > LEAST_SHARE) & (seen.alpha[two] - front.alpha > LEAST_SHARE)
    two = two[kept]
    if not len(two):
        return whole(rays, seen)

    def divided(sums: Float32[np.ndarray, "r *c"], ahead: Float32[np.ndarray, "t *c"]) -> np.ndarray:
        rest = sums.copy()
        rest[two] -= ahead[kept]
        return np.concatenate([rest, ahead[kept]])

    def listed(values: Shaped[np.ndarray, " r"], ahead: Shaped[np.ndarray, " t"]) -> np.ndarray:
        return np.concatenate([values, ahead[kept]])

    parts = TraceResult(
        rgb_srgb=divided(seen.rgb_srgb, front.rgb_srgb),
        transmittance=1 - divided(seen.alpha, front.alpha),
        depth_sum=divided(seen.depth_sum, front.depth_sum),
        depth_median=listed(seen.depth_median, front.depth_median),
        normal_world=divided(seen.normal_world, front.normal_world),
        features=divided(seen.features, front.features),
        hit_counts=listed(seen.hit_counts, front.hit_counts),
    )
    return Parted(joined(rays, front_rays[kept]), parts, two, front.recording, kept)
