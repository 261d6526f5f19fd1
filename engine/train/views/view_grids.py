"""Small pictures of many views: each rendered on a fixed grid of its pixels."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.shading.protocol import ShadingModel, TracedRays
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.sampling.batches import grid_pixels
from octasplat.engine.train.sampling.pixel_sampler import TrainingData, view_sizes_px
from octasplat.engine.train.shading_factory import find_exposures

VIEWS_PER_TRACE = 64
BRIGHTNESS_TILES = 2
"""So many tiles each way tell how bright a view is.

See :func:`octasplat.engine.train.sampling.batches.grid_pixels`.
"""


@dataclass(frozen=True, eq=False)
class RenderedGrids:
    """Some views on their grids.

    Attributes:
        pixels: view, y and x of every pixel, one view after the other.
        rgb_srgb: what the Gaussians show there, display values in [0, 1].
    """

    pixels: tuple[Int64[np.ndarray, " r"], Int64[np.ndarray, " r"], Int64[np.ndarray, " r"]]
    rgb_srgb: Float32[np.ndarray, "v p 3"]


def render_grids(
    dataset: TrainingData,
    indices: Int64[np.ndarray, " v"],
    background_srgb: Float32[np.ndarray, "3"],
    tracer: Tracer,
    shading: ShadingModel,
    *,
    tiles: int,
    exposed: bool,
) -> Iterator[RenderedGrids]:
    """Yield the views ``indices``, some at a time, as the Gaussians that ``tracer`` holds show them.

    Args:
        dataset: whose views they are.
        indices: the views.
        background_srgb: lies behind everything.
        tracer: built around the Gaussians.
        shading: makes pictures of what is traced.
        tiles: so many each way of a view, see :func:`octasplat.engine.train.sampling.batches.grid_pixels`.
        exposed: as exposed as each view is; else as the mean exposure shows the scene.
    """
    for start in range(0, len(indices), VIEWS_PER_TRACE):
        part = indices[start : start + VIEWS_PER_TRACE]
        pixels = grid_pixels(part, view_sizes_px(dataset), tiles)
        rays = dataset.rays(*pixels)
        shaded = shading.shade(TracedRays(rays, tracer.trace(rays), tracer, pixels[0] if exposed else None))
        rendered = np.clip(shaded.composite_over(background_srgb), 0, 1)
        yield RenderedGrids(pixels, rendered.reshape(len(part), -1, 3))


def estimate_untrained_exposures(
    dataset: TrainingData, background_srgb: Float32[np.ndarray, "3"], tracer: Tracer, shading: ShadingModel
) -> None:
    """Give held-out views the exposures that a camera would choose there, where exposures are learnt."""
    exposures = find_exposures(shading)
    # not before a first step: all exposures are alike then
    if exposures is not None and exposures.steps.any():
        names = [view.name for view in dataset.views]
        exposures.estimate_untrained(names, _mean_brightness(dataset, background_srgb, tracer, shading))


def _mean_brightness(
    dataset: TrainingData, background_srgb: Float32[np.ndarray, "3"], tracer: Tracer, shading: ShadingModel
) -> Float64[np.ndarray, " v"]:
    """Return the mean display value that each view would have with the mean exposure."""
    rendered = render_grids(
        dataset, np.arange(len(dataset.views)), background_srgb, tracer, shading,
        tiles=BRIGHTNESS_TILES, exposed=False,
    )  # fmt: skip
    return np.concatenate([grids.rgb_srgb.mean(axis=(1, 2), dtype=np.float64) for grids in rendered])
