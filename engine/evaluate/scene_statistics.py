"""Statistics of a scene of Gaussians: count, sizes, opacities and tracing cost."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.rays import ImageRays
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.rows import row_arrays
from octasplat.engine.render.framing import VisibleBounds, core_gaussians, visible_bounds
from octasplat.engine.render.renderer import tile_order
from octasplat.engine.trace.protocol import Tracer

OPACITY_EDGES = (0.0, 0.01, 0.1, 0.3, 0.6, 0.9, 1.0)
QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)


@dataclass(frozen=True)
class Box:
    """An axis-aligned box, world units."""

    low_world: tuple[float, float, float]
    high_world: tuple[float, float, float]


@dataclass(frozen=True)
class SceneStatistics:
    """Facts on the Gaussians alone.

    Attributes:
        count: of Gaussians.
        sh_degree: of the harmonics.
        channels: named channels and their widths.
        box: around all centres.
        box_solid: around the centres of those that are solid and not far outside of where most are.
        seen: an upright cylinder around those, as turntables frame them.
        opacity_counts: how many lie between each two of ``OPACITY_EDGES``.
        scale_quantiles: ``QUANTILES`` of the larger standard deviation, world units.
        flatness_median: median ratio of the smaller standard deviation in the plane to the larger one.
        megabytes: of the parameters in memory.
    """

    count: int
    sh_degree: int
    channels: dict[str, int]
    box: Box
    box_solid: Box
    seen: VisibleBounds
    opacity_counts: tuple[int, ...]
    scale_quantiles: tuple[float, ...]
    flatness_median: float
    megabytes: float


@dataclass(frozen=True)
class HitStatistics:
    """Gaussians that rays meet before little light is left.

    Attributes:
        mean: over the rays that meet any.
        p95: 95th percentile of these.
        share: of all rays that meet any.
    """

    mean: float
    p95: float
    share: float


def scene_statistics(gaussians: FlatGaussians, up_world: Float64[np.ndarray, "3"]) -> SceneStatistics:
    """Return the statistics of a scene of at least one Gaussian; ``up_world`` is the axis of the cylinder."""
    scales = gaussians.scales.astype(np.float64)
    larger = scales.max(axis=1)
    counts, _ = np.histogram(gaussians.opacities, bins=np.array(OPACITY_EDGES))
    size = sum(array.nbytes for array in row_arrays(gaussians).values())
    return SceneStatistics(
        count=len(gaussians),
        sh_degree=gaussians.sh_degree,
        channels=gaussians.channels.widths,
        box=_bounding_box(gaussians.means_world),
        box_solid=_bounding_box(gaussians.means_world[core_gaussians(gaussians)]),
        seen=visible_bounds(gaussians, up_world),
        opacity_counts=tuple(int(count) for count in counts),
        scale_quantiles=tuple(float(value) for value in np.quantile(larger, QUANTILES)),
        flatness_median=float(np.median(scales.min(axis=1) / larger)),
        megabytes=size / 1e6,
    )


def hit_statistics(tracer: Tracer, image: ImageRays) -> HitStatistics:
    """Return how many Gaussians the rays of an image hit; ``tracer`` has the scene built."""
    # In tiles, as tracers follow neighboring rays together
    hits = tracer.trace(image.rays[tile_order(image.height_px, image.width_px)]).hit_counts
    some = hits[hits > 0]
    if len(some) == 0:
        return HitStatistics(0.0, 0.0, 0.0)
    return HitStatistics(float(some.mean()), float(np.quantile(some, 0.95)), len(some) / len(hits))


def _bounding_box(points: np.ndarray) -> Box:
    low, high = points.min(axis=0), points.max(axis=0)
    return Box(tuple(map(float, low)), tuple(map(float, high)))  # type: ignore[arg-type]
