"""Pixels that train a block: the tiles of the photographs to whose rays its Gaussians contribute."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.protocol import TraceGradients, Tracer
from octasplat.engine.train.sampling.pixel_sampler import FULL_FREQUENCY, Rectangles, TrainingData

TILE_PX = 64
"""Side of a tile of large views, about; of views whose longer side is less than a dozen of these, less."""
TILES_ACROSS = 12
MIN_TILE_PX = 16
RAYS_ACROSS_TILE = 4
"""So many rays each way tell what a tile shows."""
MIN_CONTRIBUTION = 0.05
"""Share of a ray's color that a block's Gaussians must make in some ray of a tile for it to be trained on."""
MIN_FREQUENCY = 1
"""Least frequency of a chosen tile: what the block grows there is held against the photographs, too."""
BLOCKS_PER_TRACE = 8


@dataclass(frozen=True, eq=False)
class ViewTiles:
    """Tiles of one view, row by row, and the rays that tell what they show.

    Attributes:
        view: index of the view.
        rows_px: rows between which tiles lie, ascending, from 0 to the height.
        columns_px: likewise columns.
    """

    view: int
    rows_px: Int64[np.ndarray, " a"]
    columns_px: Int64[np.ndarray, " b"]

    @classmethod
    def of_view(cls, view: int, width_px: int, height_px: int, min_side_px: int = 1) -> "ViewTiles":
        """Return the tiles of a view, none of which has a side of less than ``min_side_px``, if that goes."""
        side = int(np.clip(max(width_px, height_px) // TILES_ACROSS, MIN_TILE_PX, TILE_PX))
        side = max(side, min_side_px)
        return cls(view, _edges(height_px, side), _edges(width_px, side))

    @property
    def shape(self) -> tuple[int, int]:
        """Return the number of tiles from top to bottom and across."""
        return len(self.rows_px) - 1, len(self.columns_px) - 1

    def pixels(self) -> tuple[Int64[np.ndarray, " r"], Int64[np.ndarray, " r"], Int64[np.ndarray, " r"]]:
        """Return view, y and x of the rays, ``RAYS_ACROSS_TILE`` each way of each tile, row by row."""
        y, x = _centres(self.rows_px), _centres(self.columns_px)
        rows, columns = np.repeat(y, len(x)), np.tile(x, len(y))
        return np.full(len(rows), self.view, np.int64), rows, columns

    def tile_maxima(self, values: Float32[np.ndarray, "r b"]) -> Float32[np.ndarray, "a c b"]:
        """Return the largest value among the rays of each tile."""
        down, across = self.shape
        shape = (down, RAYS_ACROSS_TILE, across, RAYS_ACROSS_TILE, values.shape[1])
        return np.asarray(values.reshape(shape).max(axis=(1, 3)))

    def tile_sums(self, values: Float32[np.ndarray, "r b"]) -> Float64[np.ndarray, "a c b"]:
        """Return the sum of the values of the rays of each tile."""
        down, across = self.shape
        shape = (down, RAYS_ACROSS_TILE, across, RAYS_ACROSS_TILE, values.shape[1])
        return np.asarray(values.astype(np.float64).reshape(shape).sum(axis=(1, 3)))

    def rectangles(self, frequency: Int64[np.ndarray, "a b"]) -> Rectangles:
        """Return the tiles of which something is drawn, those of one frequency in a row as one."""
        padded = np.pad(frequency, ((0, 0), (1, 1)))
        row, place = np.nonzero(np.diff(padded, axis=1))  # where a run ends, begins, or both
        first = padded[row, place + 1] > 0
        ends = padded[row, place] > 0
        corners = np.stack([self.columns_px[place[first]], self.rows_px[row[first]]], axis=1)
        opposite = np.stack([self.columns_px[place[ends]], self.rows_px[row[ends] + 1]], axis=1)
        count = len(corners)
        drawn = padded[row[first], place[first] + 1]
        return Rectangles(np.full(count, self.view, np.int64), corners, opposite - corners, drawn)


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
        traced = tracer.trace(dataset.rays(*pixels), record=True)
        assert traced.recording is not None
        # backward of zeros: only the sums of weights are wanted
        found = tracer.backward(traced.recording, TraceGradients(np.zeros_like(traced.rgb_srgb))).numpy()
        sums[found.ids] += found.weight_sums * (view.width_px * view.height_px / len(pixels[0]))
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
        found += [_join(rectangles) for rectangles in parts]
    return found


def _join(parts: Sequence[Rectangles]) -> Rectangles:
    return Rectangles(
        np.concatenate([part.view for part in parts]),
        np.concatenate([part.corner_px for part in parts]),
        np.concatenate([part.size_px for part in parts]),
        np.concatenate([part.frequency for part in parts]),
    )


def _frequencies(
    of_members: Float64[np.ndarray, "a c b"], of_all: Float64[np.ndarray, "a c 1"]
) -> Int64[np.ndarray, "a c b"]:
    """Return how often to draw tiles of which members show so much of all that is shown."""
    shares = of_members / np.maximum(of_all, 1e-6)
    parts = np.rint(FULL_FREQUENCY * shares).astype(np.int64)
    return np.clip(parts, MIN_FREQUENCY, FULL_FREQUENCY)


def _edges(length_px: int, side_px: int) -> Int64[np.ndarray, " e"]:
    """Return the places at which tiles of at least ``side_px`` begin and end."""
    count = max(1, length_px // side_px)
    return np.arange(count + 1) * length_px // count


def _centres(edges_px: Int64[np.ndarray, " e"]) -> Int64[np.ndarray, " c"]:
    """Return the pixels in the middle of ``RAYS_ACROSS_TILE`` parts of each tile."""
    starts, sizes = edges_px[:-1, None], np.diff(edges_px)[:, None]
    places = (2 * np.arange(RAYS_ACROSS_TILE) + 1) * sizes // (2 * RAYS_ACROSS_TILE)
    return (starts + places).reshape(-1)
