"""Tiles of the training views in which rays pass an edge, learnt from rays that are traced anyway."""

import math

import numpy as np
from jaxtyping import Bool, Int64, UInt8
from scipy.ndimage import binary_dilation

from octasplat.engine.dataset.view_tiles import Rectangles, ViewTiles
from octasplat.engine.train.sampling.pixel_sampler import PixelSampler

MAX_TILES = 700_000
"""Of all views together."""
MISSES_KEPT = 3
"""Batches in a row that must see no edge in a tile before it counts as one without."""
_WITH_NEIGHBOURS = np.ones((3, 3), bool)


class EdgeTiles:
    """Where rays pass an edge: of a thing before nothing, or of one surface before another.

    Tiles that were not looked at often enough count as ones with an edge, so that all are drawn at first.

    Args:
        views: the training views.
        sizes_px: width and height of every view of the dataset, by view index.

    Example:
        >>> tiles = EdgeTiles(np.array([0]), np.array([[4, 2]]))
        >>> view, y, x = np.zeros(8, np.int64), np.repeat([0, 1], 4), np.tile([0, 1, 2, 3], 2)
        >>> for _ in range(MISSES_KEPT):
        ...     tiles.observe(view, y, x, (x == 0) & (y == 0))
        >>> tiles.rectangles().corner_px.tolist(), tiles.rectangles().size_px.tolist()
        ([[0, 0], [0, 1]], [[2, 1], [2, 1]])
    """

    def __init__(self, views: Int64[np.ndarray, " v"], sizes_px: Int64[np.ndarray, "n 2"]) -> None:
        self._views = views
        self._sizes_px = sizes_px
        self._pixel_count = int(sizes_px[views].prod(axis=1).sum())
        self._side_px = max(1, math.ceil(math.sqrt(self._pixel_count / MAX_TILES)))
        self._shapes = -(-sizes_px // self._side_px)
        counts = np.zeros(len(sizes_px), np.int64)
        counts[views] = self._shapes[views].prod(axis=1)
        self._begins = np.cumsum(counts) - counts
        self._misses_left: UInt8[np.ndarray, " t"] = np.full(int(counts.sum()), MISSES_KEPT, np.uint8)

    def observe(
        self,
        view: Int64[np.ndarray, " r"],
        y: Int64[np.ndarray, " r"],
        x: Int64[np.ndarray, " r"],
        passes_edge: Bool[np.ndarray, " r"],
    ) -> None:
        """Take note of which rays of a batch pass an edge.

        Args:
            view: training view of each ray.
            y: row of its pixel.
            x: column of its pixel.
            passes_edge: whether it passes one.
        """
        tile = self._begins[view] + y // self._side_px * self._shapes[view, 0] + x // self._side_px
        tiles, row = np.unique(tile, return_inverse=True)
        has_edge = np.bincount(row, passes_edge) > 0
        left = self._misses_left[tiles]
        self._misses_left[tiles] = np.where(has_edge, MISSES_KEPT, left - (left > 0))

    def rectangles(self) -> Rectangles:
        """Return the pixels of the tiles with an edge, and of those beside them."""
        found = []
        for view in self._views.tolist():
            across, down = self._shapes[view].tolist()
            begin = int(self._begins[view])
            has_edge = self._misses_left[begin : begin + across * down].reshape(down, across) > 0
            width, height = self._sizes_px[view].tolist()
            tiles = ViewTiles(view, self._cuts(height), self._cuts(width))
            near = binary_dilation(has_edge, _WITH_NEIGHBOURS)
            found.append(tiles.rectangles(near.astype(np.int64)))
        return Rectangles.joined(found)

    def sampler(self, excluded_views: Int64[np.ndarray, " m"]) -> tuple[PixelSampler, float] | None:
        """Return a sampler of the pixels at edges, and their share of all pixels; None where there are none.

        Args:
            excluded_views: from which nothing is to be drawn.
        """
        found = self.rectangles()
        if len(excluded_views):
            found = found.of_views(np.setdiff1d(self._views, excluded_views))
        if len(found) == 0:
            return None
        return PixelSampler.of_rectangles(found), found.pixel_count / self._pixel_count

    def state(self) -> UInt8[np.ndarray, " t"]:
        """Return what was observed, for a checkpoint."""
        return self._misses_left.copy()

    def restore(self, state: UInt8[np.ndarray, " t"]) -> None:
        """Take back what :meth:`state` gave; of other tiles nothing."""
        if state.shape == self._misses_left.shape:
            self._misses_left = state.copy()

    def _cuts(self, length_px: int) -> Int64[np.ndarray, " e"]:
        return np.append(np.arange(0, length_px, self._side_px), length_px)
