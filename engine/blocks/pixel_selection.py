"""Pixels that train a block: the tiles of the photographs to whose rays its Gaussians contribute."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float64, Int64

from octasplat.engine.dataset.view_tiles import FULL_FREQUENCY, Rectangles, ViewTiles
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.trace.weight_sums import blend_weight_sums
from octasplat.engine.train.sampling.pixel_sampler import TrainingData

MIN_CONTRIBUTION = 0.05
"""Share of a ray's color that a block's Gaussians must make in some ray of a tile for it to be trained on."""
MIN_FREQUENCY = 1
"""Least frequency of a chosen tile: what the block grows there is held against the photographs, too."""
BLOCKS_PER_TRACE = 8


def tiles_of_views(dataset: TrainingData, min_side_px: int = 1) -> Iterator[ViewTiles]:
    """Yield the tiles of each training view."""
    for index in dataset.train_indices.tolist():
        view = dataset.views[index]
        yield ViewTiles.of_view(index, view.width_px, view.height_px, min_side_px)


def seen_pixels(
    dataset: TrainingData, gaussians: FlatGaussians, tracer: Tracer, on_view: Callable[[], None]
) -> Float64[np.ndarray, " n"]:
    """Return the pixels of the training views that show each Gaussian, weighted by how much it is seen.

    Args:
        dataset: the photographs.
        gaussians: the scene.
        tracer: is built around them.
        on_view: called after each view; it may raise to stop.
    """
    tracer.build(gaussians)
    sums = np.zeros(len(gaussians))
    for tiles in tiles_of_views(dataset):
        pixels = tiles.pixels()
        view = dataset.views[tiles.view]
        weights = blend_weight_sums(tracer, dataset.rays(*pixels), len(gaussians))
        sums += weights * (view.width_px * view.height_px / len(pixels[0]))
        on_view()
    return sums


def select_pixels(
    dataset: TrainingData,
    gaussians: FlatGaussians,
    members: Sequence[Bool[np.ndarray, " n"]],
    tracer: Tracer,
    on_view: Callable[[], None],
    *,
    min_side_px: int = 1,
) -> list[Rectangles]:
    """Return the tiles in which the members of each block contribute to a ray, and how often to draw each.

    A tile is drawn in proportion to what the members make of what its rays show: so that over all blocks a
    pixel is drawn about as often as in a training of the whole scene.

    Args:
        dataset: the photographs.
        gaussians: the scene.
        members: which Gaussians belong to each block.
        tracer: is built around the Gaussians.
        on_view: called after each view, once for every :data:`BLOCKS_PER_TRACE` blocks; it may raise to stop.
        min_side_px: least side of a tile, as far as views have it.
    """
    found: list[Rectangles] = []
    for first in range(0, len(members), BLOCKS_PER_TRACE):
        part = members[first : first + BLOCKS_PER_TRACE]
        tracer.build(gaussians, np.stack(part, axis=1).astype(np.float32))
        parts: list[list[Rectangles]] = [[] for _ in part]
        for tiles in tiles_of_views(dataset, min_side_px):
            traced = tracer.trace(dataset.rays(*tiles.pixels()))
            is_chosen = tiles.tile_maxima(traced.features) >= MIN_CONTRIBUTION
            frequencies = _frequencies(
                tiles.tile_sums(traced.features), tiles.tile_sums(traced.alpha[:, None])
            )
            frequencies[~is_chosen] = 0
            for block, rectangles in enumerate(parts):
                rectangles.append(tiles.rectangles(frequencies[:, :, block]))
            on_view()
        found += [Rectangles.joined(rectangles) for rectangles in parts]
    return found


def _frequencies(
    of_members: Float64[np.ndarray, "a c b"], of_all: Float64[np.ndarray, "a c 1"]
) -> Int64[np.ndarray, "a c b"]:
    """Return how often to draw tiles of which members show so much of all that is shown."""
    shares = of_members / np.maximum(of_all, 1e-6)
    parts = np.rint(FULL_FREQUENCY * shares).astype(np.int64)
    return np.clip(parts, MIN_FREQUENCY, FULL_FREQUENCY)
