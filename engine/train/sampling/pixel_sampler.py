"""What training needs of a dataset, and pixels drawn from its views: singly, in ray patches, or in blocks."""

import math
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int64

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.dataset import DatasetView
from octasplat.engine.dataset.view_tiles import Rectangles
from octasplat.engine.shading.ray_patches import morton_cells

GOLDEN_RATIO = (math.sqrt(5) - 1) / 2
"""Its multiples fill the unit interval evenly, however many there are."""
VALID_PIXEL_SAMPLES = 20_000
"""Pixels by which the share of valid ones is estimated, always the same: it is right to 0.4 %."""


@runtime_checkable
class PixelSource(Protocol):
    """Interface of a dataset that training needs (see :class:`octasplat.engine.dataset.Dataset`)."""

    def rays(
        self, view: Int64[np.ndarray, " r"], y: Int64[np.ndarray, " r"], x: Int64[np.ndarray, " r"]
    ) -> RayBatch:
        """Return unit rays of pixels, world frame."""
        ...

    def pixels(
        self, view: Int64[np.ndarray, " r"], y: Int64[np.ndarray, " r"], x: Int64[np.ndarray, " r"]
    ) -> tuple[Float32[np.ndarray, "r 3"], Float32[np.ndarray, " r"], Float32[np.ndarray, " r"]]:
        """Return straight display color, alpha, and weight (0 where masked) of pixels."""
        ...


@runtime_checkable
class TrainingData(PixelSource, Protocol):
    """The photographs: pixel access, the views and the split.

    See :class:`octasplat.engine.dataset.Dataset`.
    """

    views: tuple[DatasetView, ...]
    train_indices: Int64[np.ndarray, " t"]
    test_indices: Int64[np.ndarray, " h"]
    has_alpha: bool
    extent: float


@runtime_checkable
class PartialTrainingData(TrainingData, Protocol):
    """Photographs of which only some pixels may be trained on; all of them where none are named."""

    trained_pixels: Rectangles | None


def trained_pixels(dataset: TrainingData) -> Rectangles | None:
    """Return the pixels that are trained on; None stands for all of them."""
    return dataset.trained_pixels if isinstance(dataset, PartialTrainingData) else None


@runtime_checkable
class MeasuredTrainingData(TrainingData, Protocol):
    """Photographs of which some have depth maps."""

    has_known_distances: bool

    def known_distances(
        self, view: Int64[np.ndarray, " r"], y: Int64[np.ndarray, " r"], x: Int64[np.ndarray, " r"]
    ) -> Float32[np.ndarray, " r"]:
        """Return distances of the surface along the rays of pixels, world units; 0 where unknown."""
        ...


def has_known_distances(dataset: TrainingData) -> bool:
    """Return whether depth maps tell anything of the photographs."""
    return isinstance(dataset, MeasuredTrainingData) and dataset.has_known_distances


def known_distances(
    dataset: TrainingData,
    view: Int64[np.ndarray, " r"],
    y: Int64[np.ndarray, " r"],
    x: Int64[np.ndarray, " r"],
) -> Float32[np.ndarray, " r"]:
    """Return distances of the surface along the rays of pixels, world units; 0 where unknown."""
    if isinstance(dataset, MeasuredTrainingData):
        return dataset.known_distances(view, y, x)
    return np.zeros(len(view), np.float32)


def pixel_sampler(dataset: TrainingData, view_indices: Int64[np.ndarray, " v"]) -> "PixelSampler":
    """Return a sampler of some views: of all their pixels, or of those that are trained on."""
    trained = trained_pixels(dataset)
    if trained is not None:
        return PixelSampler.of_rectangles(trained.of_views(view_indices))
    return PixelSampler(view_indices, view_sizes_px(dataset))


class PixelSampler:
    """Draws pixels uniformly over all pixels of the given views, or of rectangles by how often each is drawn.

    Args:
        view_indices: the views to draw from.
        sizes_px: width and height of every view of the dataset, by view index.
    """

    def __init__(self, view_indices: Int64[np.ndarray, " v"], sizes_px: Int64[np.ndarray, "n 2"]) -> None:
        self._views = view_indices
        self._sizes = sizes_px[view_indices]
        self._corners = np.zeros_like(self._sizes)
        self._frequency = np.ones(len(view_indices), np.int64)
        self._lengths = self._sizes[:, 0] * self._sizes[:, 1]
        self._ends = np.cumsum(self._lengths)
        self._pixel_count = int(self._lengths.sum())

    @classmethod
    def of_rectangles(cls, rectangles: Rectangles) -> "PixelSampler":
        """Return a sampler of the pixels in rectangles, each of which is drawn from as a view is."""
        sampler = cls(np.arange(len(rectangles)), rectangles.size_px)
        sampler._views, sampler._corners = rectangles.view, rectangles.corner_px
        sampler._frequency = rectangles.frequency
        sampler._lengths = sampler._lengths * rectangles.frequency
        sampler._ends = np.cumsum(sampler._lengths)
        sampler._pixel_count = rectangles.drawn_pixel_count
        return sampler

    @property
    def pixel_count(self) -> int:
        """Return the number of pixels in all views; those drawn less often count less."""
        return self._pixel_count

    @property
    def smallest_side_px(self) -> int:
        """Return the shortest side of any view."""
        return int(self._sizes.min())

    @property
    def longest_side_px(self) -> int:
        """Return the longest side of any view."""
        return int(self._sizes.max())

    def pixels(
        self, rng: np.random.Generator, count: int
    ) -> tuple[Int64[np.ndarray, " r"], Int64[np.ndarray, " r"], Int64[np.ndarray, " r"]]:
        """Draw ``count`` pixels as (view, y, x), repeated ones too, sorted by view and row."""
        # sorted, so that neighboring rays read neighboring pixels
        flat = np.sort(rng.integers(0, self._ends[-1], count))
        view_rows = np.searchsorted(self._ends, flat, side="right")
        width = self._sizes[view_rows, 0]
        local = (flat - (self._ends - self._lengths)[view_rows]) // self._frequency[view_rows]
        left, top = self._corners[view_rows].T
        return self._views[view_rows], top + local // width, left + local % width

    def ray_patches(
        self, rng: np.random.Generator, count: int, *, rays: int, side: int, index: int = 0
    ) -> tuple[Int64[np.ndarray, " r"], Int64[np.ndarray, " r"], Int64[np.ndarray, " r"]]:
        """Draw ``rays`` pixels (a square number) in each of ``count`` patches of about ``side`` px a side.

        A patch is a grid of cells, one random pixel in each, in the order of
        :class:`octasplat.engine.shading.ray_patches.RayPatches`. What sticks out of its view
        is folded back, so that every pixel is about as likely as any other. Patches are spread over views and
        within them, and those of one ``index`` after the other over what those before have left.
        """
        cells = math.isqrt(rays)
        cell = max(1, round(side / cells))
        view_rows, x, y = self._stratified_pixels(rng, count, cell * cells, index)
        width, height = self._sizes[view_rows].T
        rows, columns = morton_cells(cells)
        left, top = x - cell * cells // 2, y - cell * cells // 2
        y = top[:, None] + rows * cell + rng.integers(0, cell, (count, rays))
        x = left[:, None] + columns * cell + rng.integers(0, cell, (count, rays))
        view = np.broadcast_to(self._views[view_rows][:, None], x.shape)
        corner_x, corner_y = self._corners[view_rows].T
        return (
            view.reshape(-1),
            (corner_y[:, None] + _mirror_into(y, height[:, None])).reshape(-1),
            (corner_x[:, None] + _mirror_into(x, width[:, None])).reshape(-1),
        )

    def _stratified_pixels(
        self, rng: np.random.Generator, count: int, side: int, index: int
    ) -> tuple[Int64[np.ndarray, " c"], Int64[np.ndarray, " c"], Int64[np.ndarray, " c"]]:
        """Draw ``count`` pixels in strata, as (place of the view among those drawn from, x, y).

        All views lie end to end, each as a way to and fro through tiles of about ``side`` x ``side`` pixels;
        steps of one length lead along it, each to a random pixel of the tile there. Each turn begins the
        golden section of a step further on, so that all tiles are seen equally often.
        """
        at = (np.arange(count) + index * GOLDEN_RATIO % 1.0) * (int(self._ends[-1]) / count)
        view_rows = np.searchsorted(self._ends, at, side="right")
        width, height = self._sizes[view_rows].T
        length = self._lengths[view_rows]
        share = (at - (self._ends[view_rows] - length)) / length
        columns = np.maximum(1, np.rint(width / side).astype(np.int64))
        rows = np.maximum(1, np.rint(height / side).astype(np.int64))
        row, column = np.divmod((share * columns * rows).astype(np.int64), columns)
        # to and fro, so that neighbors along the way are neighbors in the view
        column = np.where(row % 2 == 1, columns - 1 - column, column)
        x = (column + rng.random(count)) * (width / columns)
        y = (row + rng.random(count)) * (height / rows)
        return view_rows, x.astype(np.int64), y.astype(np.int64)

    def patches(
        self, rng: np.random.Generator, count: int, side: int
    ) -> tuple[Int64[np.ndarray, " r"], Int64[np.ndarray, " r"], Int64[np.ndarray, " r"]]:
        """Draw ``count`` patches of ``side`` x ``side`` pixels inside the views: (view, y, x), row-major."""
        areas = self._lengths
        # patches by area: any pixel is about as likely
        view_rows = rng.choice(len(self._views), size=count, p=areas / areas.sum())
        width, height = self._sizes[view_rows].T
        left = rng.integers(0, width - side + 1)
        top = rng.integers(0, height - side + 1)
        left, top = left + self._corners[view_rows, 0], top + self._corners[view_rows, 1]
        shape = (count, side, side)
        rows, columns = np.arange(side)[None, :, None], np.arange(side)[None, None, :]
        view = np.broadcast_to(self._views[view_rows][:, None, None], shape)
        y = np.broadcast_to(top[:, None, None] + rows, shape)
        x = np.broadcast_to(left[:, None, None] + columns, shape)
        return view.reshape(-1), y.reshape(-1), x.reshape(-1)


def _mirror_into(
    position: Int64[np.ndarray, "w r"], size: Int64[np.ndarray, "w 1"]
) -> Int64[np.ndarray, "w r"]:
    """Return positions mirrored at 0 and ``size`` until they lie between."""
    period = np.mod(position, 2 * size)
    return np.minimum(period, 2 * size - 1 - period)


def view_sizes_px(dataset: TrainingData) -> Int64[np.ndarray, "n 2"]:
    """Return width and height of every view."""
    return np.array([[view.width_px, view.height_px] for view in dataset.views], np.int64)


def valid_pixel_fraction(dataset: TrainingData) -> float:
    """Return the share of the training views' pixels that show something; at least that of one pixel.

    Raises:
        DatasetError: masks or alpha leave nothing of the training photographs.
    """
    sampler = pixel_sampler(dataset, dataset.train_indices)
    view, y, x = sampler.pixels(np.random.Generator(np.random.PCG64(0)), VALID_PIXEL_SAMPLES)
    _, alpha, weight = dataset.pixels(view, y, x)
    valid_count = int(((alpha > 0) & (weight > 0)).sum())
    if valid_count == 0 and _has_no_valid_pixel(dataset):  # the sample may have missed the few valid ones
        raise DatasetError(
            "The training photographs show nothing: their masks or alpha leave no pixel. Masks are white "
            "where a pixel counts; invert them, or leave them out."
        )
    return max(1, valid_count) / VALID_PIXEL_SAMPLES


def _has_no_valid_pixel(dataset: TrainingData) -> bool:
    """Return whether no pixel at all of the training views is valid."""
    for index in dataset.train_indices.tolist():
        view = dataset.views[index]
        y, x = np.divmod(np.arange(view.width_px * view.height_px), view.width_px)
        _, alpha, weight = dataset.pixels(np.full(len(y), index), y, x)
        if ((alpha > 0) & (weight > 0)).any():
            return False
    return True
