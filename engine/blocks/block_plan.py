"""Blocks of a scene: their boxes, the Gaussians in and around them, and the pixels that train them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from octasplat.engine.blocks.partition import Box, cut_into_boxes, weighted_spread
from octasplat.engine.blocks.piece_settings import MARGIN
from octasplat.engine.blocks.pixel_selection import seen_pixels, select_pixels
from octasplat.engine.dataset.view_tiles import Rectangles
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.sampling.pixel_sampler import TrainingData

MIN_VIEWS = 4
"""A block that fewer views show keeps the coarse Gaussians."""


@dataclass(frozen=True, eq=False)
class Block:
    """A part of a scene.

    Attributes:
        core: whose Gaussians are kept in the end; the cores of all blocks cover all space.
        margin_world: of what is trained beyond the core, along each axis.
        share: of the pixels that show the scene, those that show this block and its margin.
        pixels: that train it.
    """

    core: Box
    margin_world: Float64[np.ndarray, "3"]
    share: float
    pixels: Rectangles

    @property
    def trained(self) -> Box:
        """Return the core with its margin."""
        return self.core.grown(self.margin_world)

    @property
    def view_count(self) -> int:
        """Return the number of views that train it."""
        return len(np.unique(self.pixels.view))

    @property
    def is_trained(self) -> bool:
        """Return whether enough views show it."""
        return self.view_count >= MIN_VIEWS


def plan_blocks(
    dataset: TrainingData,
    gaussians: FlatGaussians,
    count: int,
    tracer: Tracer,
    on_view: Callable[[], None],
    *,
    min_side_px: int = 1,
    margin: float = MARGIN,
) -> tuple[Block, ...]:
    """Cut a scene into blocks that about as many pixels show.

    Args:
        dataset: the photographs.
        gaussians: the coarse scene.
        count: number of blocks.
        tracer: for the coarse scene.
        on_view: called after each view, some times for each; it may raise to stop.
        min_side_px: least side of the tiles of pixels.
        margin: around each core, of the distance over which what is seen of it spreads.

    Raises:
        ConfigError: the scene has too few Gaussians that are seen.
    """
    seen = seen_pixels(dataset, gaussians, tracer, on_view)
    points = gaussians.means_world.astype(np.float64)
    boxes = cut_into_boxes(points, seen, count)
    margins = []
    for box in boxes:
        inside = box.contains(points) & (seen > 0)
        margins.append(margin * weighted_spread(points[inside], seen[inside]))
    members = [box.grown(width).contains(points) for box, width in zip(boxes, margins, strict=True)]
    pixels = select_pixels(dataset, gaussians, members, tracer, on_view, min_side_px=min_side_px)
    shares = [float(seen[member].sum() / seen.sum()) for member in members]
    return tuple(Block(*parts) for parts in zip(boxes, margins, shares, pixels, strict=True))
