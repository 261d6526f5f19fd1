"""Rays that show two surfaces, one behind the edge of the other, parted so that each is shaded by itself.

The photograph of an edge is the mean of two colours. Materials and normals that are blended over both
surfaces first and shaded then belong to neither. Where the mean depth of a ray lies far from its median, the
ray is traced once more as far as the mean, which lies between two surfaces wherever these are. That is the
front; what the whole ray saw beyond it is the back, as all that is blended is a sum over the ray.
"""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, Int64, Shaped

from engine.rays import RayBatch
from engine.trace.protocol import Recording, TraceGradients, Tracer, TraceResult

LEAST_SHARE = 0.05
"""Of the light of a ray that each of two surfaces takes at least."""
SUMS = ("rgb_srgb", "depth_sum", "normal_world", "features")
"""What a trace adds up along a ray, but for the transmittance."""


@dataclass(frozen=True)
class Parted:
    """What rays show, one surface at a time: ``l`` parts of ``r`` rays.

    The first ``r`` parts are the rays as they were, those of ``two`` without their front; then come the
    fronts. The transmittance of a part is one minus what it adds to the ray's accumulated alpha.

    Attributes:
        rays: of the parts.
        seen: by each part alone.
        two: numbers of the rays that show two surfaces.
        front: recording of the fronts; None if there are none, or nothing is recorded.
    """

    rays: RayBatch
    seen: TraceResult
    two: Int64[np.ndarray, " f"]
    front: Recording | None = None

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
        whole, fronts = {}, {}
        for name in (field.name for field in fields(TraceGradients)):
            value = getattr(by_parts, name)
            if value is not None:
                whole[name], fronts[name] = value[:count], value[count:] - value[self.two]
        if self.front is None:
            return TraceGradients(**whole), ()
        return TraceGradients(**whole), ((self.front, TraceGradients(**fronts)),)


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
    share = front.alpha
    kept = (share > LEAST_SHARE) & (seen.alpha[two] - share > LEAST_SHARE)
    if not kept.all():
        two, front_rays = two[kept], front_rays[np.flatnonzero(kept)]
        if not len(two):
            return whole(rays, seen)
        front = tracer.trace(front_rays, record=record)
    sums = {}
    for name in SUMS:
        ahead, all_of_it = getattr(front, name), getattr(seen, name).copy()
        all_of_it[two] -= ahead
        sums[name] = np.concatenate([all_of_it, ahead])
    behind = seen.transmittance.copy()
    behind[two] += front.alpha
    parts = TraceResult(
        **sums,
        transmittance=np.concatenate([behind, front.transmittance]),
        depth_median=np.concatenate([seen.depth_median, front.depth_median]),
        hit_counts=np.concatenate([seen.hit_counts, front.hit_counts]),
    )
    return Parted(_joined(rays, front_rays), parts, two, front.hits)


def _joined(rays: RayBatch, fronts: RayBatch) -> RayBatch:
    """One batch after the other."""

    def rows(name: str) -> np.ndarray:
        first, second = getattr(rays, name), getattr(fronts, name)
        if len(first) == 1 and np.array_equal(first, second):
            return np.asarray(first)
        wide = [np.broadcast_to(x, (len(of), *x.shape[1:])) for x, of in ((first, rays), (second, fronts))]
        return np.concatenate(wide)

    return RayBatch(
        *(rows(name) for name in ("origins_world", "directions_world", "t_min", "t_max", "t_viewer"))
    )
