"""Tiles of views, and rectangles of their pixels, each drawn as often as it is told."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

TILE_PX = 64
"""Side of a tile of large views, about; of views whose longer side is less than a dozen of these, less."""
TILES_ACROSS = 12
MIN_TILE_PX = 16
RAYS_ACROSS_TILE = 4
"""So many rays each way tell what a tile shows."""
FULL_FREQUENCY = 8
"""Parts in which it is counted how often pixels of a rectangle are drawn."""


@dataclass(frozen=True, eq=False)
class Rectangles:
    """Rectangles of pixels of some views, none of which overlap; a view may have several.

    Attributes:
        view: index of the view of each, ascending.
        corner_px: x and y of the first pixel.
        size_px: width and height, 1 at least.
        frequency: how often a pixel of each is drawn, in parts of :data:`FULL_FREQUENCY`, 1 at least; none
            given stands for all of them.
    """

    view: Int64[np.ndarray, " k"]
    corner_px: Int64[np.ndarray, "k 2"]
    size_px: Int64[np.ndarray, "k 2"]
    frequency: Int64[np.ndarray, " k"] = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        if len(self.frequency) != len(self.view):
            object.__setattr__(self, "frequency", np.full(len(self.view), FULL_FREQUENCY))

    def __len__(self) -> int:
        return len(self.view)

    @property
    def pixel_count(self) -> int:
        """Return the number of pixels in all of them."""
        return int(self.size_px.prod(axis=1).sum())

    @property
    def drawn_pixel_count(self) -> int:
        """Return how many pixels that are drawn at full frequency would take as long, 1 at least."""
        return max(1, int((self.size_px.prod(axis=1) * self.frequency).sum()) // FULL_FREQUENCY)

    @classmethod
    def joined(cls, parts: Sequence["Rectangles"]) -> "Rectangles":
        """Return the rectangles of all parts, those of one after those of the other; at least one part."""
        return cls(
            np.concatenate([part.view for part in parts]),
            np.concatenate([part.corner_px for part in parts]),
            np.concatenate([part.size_px for part in parts]),
            np.concatenate([part.frequency for part in parts]),
        )

    def of_views(self, views: Int64[np.ndarray, " v"]) -> "Rectangles":
        """Return those of some views."""
        return self._select(np.isin(self.view, views))

    def of_frequency(self, frequency: int) -> "Rectangles":
        """Return those that are drawn so often."""
        return self._select(self.frequency == frequency)

    def _select(self, is_kept: Bool[np.ndarray, " k"]) -> "Rectangles":
        return Rectangles(
            self.view[is_kept], self.corner_px[is_kept], self.size_px[is_kept], self.frequency[is_kept]
        )


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


def _edges(length_px: int, side_px: int) -> Int64[np.ndarray, " e"]:
    """Return the places at which tiles of at least ``side_px`` begin and end."""
    count = max(1, length_px // side_px)
    return np.arange(count + 1) * length_px // count


def _centres(edges_px: Int64[np.ndarray, " e"]) -> Int64[np.ndarray, " c"]:
    """Return the pixels in the middle of ``RAYS_ACROSS_TILE`` parts of each tile."""
    starts, sizes = edges_px[:-1, None], np.diff(edges_px)[:, None]
    places = (2 * np.arange(RAYS_ACROSS_TILE) + 1) * sizes // (2 * RAYS_ACROSS_TILE)
    return (starts + places).reshape(-1)
