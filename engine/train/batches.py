"""Batches of rays: random pixels over all training views, mixed with square patches for SSIM."""

import math
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int64

from engine.colour import composited
from engine.errors import ConfigError
from engine.rays import RayBatch
from engine.scene import View
from engine.train.config import TrainConfig, window_side_px
from engine.train.sight_lines import PhotographsOfPoints, SightLines

TILE_PX = 8
GOLDEN = (math.sqrt(5) - 1) / 2
"""Its multiples fill the unit interval evenly, however many there are."""


@runtime_checkable
class Pixels(Protocol):
    """What training needs of a dataset (see :class:`engine.scene.Dataset`)."""

    def rays(
        self, view: Int64[np.ndarray, " r"], y: Int64[np.ndarray, " r"], x: Int64[np.ndarray, " r"]
    ) -> RayBatch:
        """Unit rays of pixels, world frame."""
        ...

    def pixels(
        self, view: Int64[np.ndarray, " r"], y: Int64[np.ndarray, " r"], x: Int64[np.ndarray, " r"]
    ) -> tuple[Float32[np.ndarray, "r 3"], Float32[np.ndarray, " r"], Float32[np.ndarray, " r"]]:
        """Straight display colour, alpha, and weight (0 where masked) of pixels."""
        ...


@runtime_checkable
class TrainingData(Pixels, Protocol):
    """The photographs: pixel access, the views and the split (see :class:`engine.scene.Dataset`)."""

    views: tuple[View, ...]
    train_indices: Int64[np.ndarray, " t"]
    test_indices: Int64[np.ndarray, " h"]
    has_alpha: bool
    extent: float


@dataclass(frozen=True)
class Batch:
    """Rays and what the photographs show there.

    The last ``patches * side * side`` rays are patches, row-major one after another. ``background_srgb`` lies
    behind both the Gaussians and photographs with alpha. ``sight_lines`` end before points that views show.
    """

    rays: RayBatch
    rgb_srgb: Float32[np.ndarray, "r 3"]
    alpha: Float32[np.ndarray, " r"]
    weight: Float32[np.ndarray, " r"]
    view: Int64[np.ndarray, " r"]
    patches: int
    side: int
    background_srgb: Float32[np.ndarray, "3"]
    sight_lines: RayBatch | None = None

    @cached_property
    def target_srgb(self) -> Float32[np.ndarray, "r 3"]:
        """The photographs' colours over the background."""
        return composited(self.rgb_srgb, self.alpha, self.background_srgb)


class PixelSampler:
    """Draws pixels uniformly over all pixels of the given views.

    Args:
        view_indices: the views to draw from.
        sizes_px: width and height of every view of the dataset, by view index.
    """

    def __init__(self, view_indices: Int64[np.ndarray, " v"], sizes_px: Int64[np.ndarray, "n 2"]) -> None:
        self._views = view_indices
        self._sizes = sizes_px[view_indices]
        self._ends = np.cumsum(self._sizes[:, 0] * self._sizes[:, 1])

    @property
    def pixel_count(self) -> int:
        """Number of pixels in all views."""
        return int(self._ends[-1])

    @property
    def smallest_side_px(self) -> int:
        """Shortest side of any view."""
        return int(self._sizes.min())

    @property
    def longest_side_px(self) -> int:
        """Longest side of any view."""
        return int(self._sizes.max())

    def pixels(
        self, rng: np.random.Generator, count: int
    ) -> tuple[Int64[np.ndarray, " r"], Int64[np.ndarray, " r"], Int64[np.ndarray, " r"]]:
        """``count`` pixels as (view, y, x), repeated ones too, sorted by view and row."""
        flat = np.sort(rng.integers(0, self.pixel_count, count))
        which = np.searchsorted(self._ends, flat, side="right")
        width, height = self._sizes[which].T
        local = flat - (self._ends[which] - width * height)
        return self._views[which], local // width, local % width

    def windows(
        self, rng: np.random.Generator, count: int, *, rays: int, side: int, turn: int = 0
    ) -> tuple[Int64[np.ndarray, " r"], Int64[np.ndarray, " r"], Int64[np.ndarray, " r"]]:
        """``rays`` pixels (a square number) in each of ``count`` windows of about ``side`` x ``side`` pixels.

        A window is a grid of cells, one random pixel in each, quarter by quarter. What sticks out of its view
        is folded back, so that every pixel is about as likely as any other. Windows are spread over views and
        within them, and those of one ``turn`` after the other over what those before have left.
        """
        cells = math.isqrt(rays)
        cell = max(1, round(side / cells))
        which, x, y = self._spread(rng, count, cell * cells, turn)
        width, height = self._sizes[which].T
        rows, columns = _in_quarters(cells)
        left, top = x - cell * cells // 2, y - cell * cells // 2
        y = top[:, None] + rows * cell + rng.integers(0, cell, (count, rays))
        x = left[:, None] + columns * cell + rng.integers(0, cell, (count, rays))
        view = np.broadcast_to(self._views[which][:, None], x.shape)
        return view.reshape(-1), _fold(y, height[:, None]).reshape(-1), _fold(x, width[:, None]).reshape(-1)

    def _spread(
        self, rng: np.random.Generator, count: int, side: int, turn: int
    ) -> tuple[Int64[np.ndarray, " c"], Int64[np.ndarray, " c"], Int64[np.ndarray, " c"]]:
        """``count`` pixels as (place of the view among those drawn from, x, y), in strata.

        All views lie end to end, each as a way to and fro through tiles of about ``side`` x ``side`` pixels;
        steps of one length lead along it, each to a random pixel of the tile there. Each turn begins the
        golden section of a step further on, so that all tiles are seen equally often.
        """
        at = (np.arange(count) + turn * GOLDEN % 1.0) * (self.pixel_count / count)
        which = np.searchsorted(self._ends, at, side="right")
        width, height = self._sizes[which].T
        share = (at - (self._ends[which] - width * height)) / (width * height)
        columns = np.maximum(1, np.rint(width / side).astype(np.int64))
        rows = np.maximum(1, np.rint(height / side).astype(np.int64))
        row, column = np.divmod((share * columns * rows).astype(np.int64), columns)
        column = np.where(row % 2 == 1, columns - 1 - column, column)
        x = (column + rng.random(count)) * (width / columns)
        y = (row + rng.random(count)) * (height / rows)
        return which, x.astype(np.int64), y.astype(np.int64)

    def patches(
        self, rng: np.random.Generator, count: int, side: int
    ) -> tuple[Int64[np.ndarray, " r"], Int64[np.ndarray, " r"], Int64[np.ndarray, " r"]]:
        """``count`` patches of ``side`` x ``side`` pixels as (view, y, x), row-major, inside the views."""
        areas = np.diff(self._ends, prepend=0)
        which = rng.choice(len(self._views), size=count, p=areas / areas.sum())
        width, height = self._sizes[which].T
        left = rng.integers(0, width - side + 1)
        top = rng.integers(0, height - side + 1)
        shape = (count, side, side)
        rows, columns = np.arange(side)[None, :, None], np.arange(side)[None, None, :]
        view = np.broadcast_to(self._views[which][:, None, None], shape)
        y = np.broadcast_to(top[:, None, None] + rows, shape)
        x = np.broadcast_to(left[:, None, None] + columns, shape)
        return view.reshape(-1), y.reshape(-1), x.reshape(-1)


def _in_quarters(cells: int) -> tuple[Int64[np.ndarray, " r"], Int64[np.ndarray, " r"]]:
    """Rows and columns of a square's cells along a Z-order curve: those side by side come close together."""
    rows, columns = np.divmod(np.arange(cells * cells), cells)
    place = np.zeros(cells * cells, np.int64)
    for bit in range(cells.bit_length()):
        place |= (rows >> bit & 1) << (2 * bit + 1) | (columns >> bit & 1) << (2 * bit)
    order = np.argsort(place)
    return rows[order], columns[order]


def _fold(position: Int64[np.ndarray, "w r"], size: Int64[np.ndarray, "w 1"]) -> Int64[np.ndarray, "w r"]:
    """Positions mirrored at 0 and ``size`` until they lie between."""
    period = np.mod(position, 2 * size)
    return np.minimum(period, 2 * size - 1 - period)


class BatchSource:
    """Draws the batches of a training.

    A batch has ``config.rays`` rays. Where the loss has an SSIM term, about ``config.patch_fraction`` of them
    come as patches; the others come in windows, as far as that goes, and singly where a window is one ray.

    Args:
        dataset: the photographs.
        config: sizes and shares.

    Raises:
        ConfigError: the SSIM term would have no patch, or a background is to be learnt where none is shown.
    """

    def __init__(self, dataset: TrainingData, config: TrainConfig) -> None:
        if config.background == "learnt" and dataset.has_alpha:
            raise ConfigError(
                "These photographs have alpha, so that they show no background; leave background=learnt out."
            )
        self._dataset = dataset
        self._config = config
        self.sampler = PixelSampler(dataset.train_indices, view_sizes_px(dataset))
        self._window_side_px = window_side_px(config, self.sampler.longest_side_px)
        self._patches = self._patch_count()
        self._lines: SightLines | None = None
        if config.loss.blocked > 0 and isinstance(dataset, PhotographsOfPoints) and len(dataset.points):
            self._lines = SightLines.of(dataset, config.sight_line_margin)

    def leave_out(self, views: Int64[np.ndarray, " m"]) -> None:
        """Draw nothing of these views any more."""
        kept = np.setdiff1d(self._dataset.train_indices, views)
        self.sampler = PixelSampler(kept, view_sizes_px(self._dataset))
        if self._lines is not None:
            self._lines = self._lines.without(views)

    def draw(self, rng: np.random.Generator, turn: int = 0) -> Batch:
        """The next batch, after ``turn`` others."""
        config, sampler, side = self._config, self.sampler, self._config.patch_side
        loose = config.rays - self._patches * side**2
        windows = loose // config.window_rays if config.window_rays > 1 else 0
        drawn = [sampler.pixels(rng, loose - windows * config.window_rays)]
        if windows:
            drawn.append(
                sampler.windows(rng, windows, rays=config.window_rays, side=self._window_side_px, turn=turn)
            )
        if self._patches:
            drawn.append(sampler.patches(rng, self._patches, side))
        view, y, x = (np.concatenate(parts) for parts in zip(*drawn, strict=True))
        rays = self._dataset.rays(view, y, x)
        rgb, alpha, weight = self._dataset.pixels(view, y, x)
        background = self._background(rng)
        lines = None
        if self._lines is not None and len(self._lines):
            lines = self._lines.draw(rng, max(1, round(config.sight_line_share * config.rays)))
        batch = Batch(rays, rgb, alpha, weight, view, self._patches, side, background, lines)
        _ = batch.target_srgb  # worked out here, as the next batch is drawn beside the iteration
        return batch

    def _patch_count(self) -> int:
        config, side = self._config, self._config.patch_side
        if config.loss.ssim == 0:
            return 0
        smallest = self.sampler.smallest_side_px
        if smallest < side:
            raise ConfigError(
                f"loss.ssim compares patches of {side} x {side} pixels, but a training view is only "
                f"{smallest} pixels wide or high; lower patch_side (16 at least), or set loss.ssim to 0."
            )
        count = min(round(config.rays * config.patch_fraction / side**2), config.rays // side**2)
        if count == 0:
            raise ConfigError(
                f"loss.ssim compares patches of {side} x {side} pixels, but a share of "
                f"{config.patch_fraction:g} of {config.rays} rays makes none; raise rays or "
                "patch_fraction, or set loss.ssim to 0."
            )
        return count

    def _background(self, rng: np.random.Generator) -> Float32[np.ndarray, "3"]:
        name = self._config.background
        if name == "auto":
            name = "random" if self._dataset.has_alpha else "black"
        if name == "random":
            return rng.random(3, dtype=np.float32)
        return still_background(self._config)


class DrawnAhead:
    """Draws batches, the next one beside whatever else goes on if it is asked for early.

    The generator is drawn from in the order of the batches either way, so that they are the same ones.

    Args:
        source: where batches come from.
    """

    def __init__(self, source: BatchSource) -> None:
        self._source = source
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="batch")
        self._next: Future[Batch] | None = None

    def __enter__(self) -> "DrawnAhead":
        return self

    def __exit__(self, *_error: object) -> None:
        self._worker.shutdown()

    def begin(self, rng: np.random.Generator, turn: int) -> None:
        """Begin the next batch; until :meth:`draw` gives it nothing else may draw from ``rng``."""
        self._next = self._worker.submit(self._source.draw, rng, turn)

    def draw(self, rng: np.random.Generator, turn: int) -> Batch:
        """The batch after ``turn`` others, begun or not."""
        begun, self._next = self._next, None
        return self._source.draw(rng, turn) if begun is None else begun.result()


def still_background(config: TrainConfig) -> Float32[np.ndarray, "3"]:
    """The background that stays the same: white if asked for, else black."""
    return np.full(3, 1.0 if config.background == "white" else 0.0, np.float32)


def view_sizes_px(dataset: TrainingData) -> Int64[np.ndarray, "n 2"]:
    """Width and height of every view."""
    return np.array([[view.width_px, view.height_px] for view in dataset.views], np.int64)


def grid_pixels(
    indices: Int64[np.ndarray, " v"], sizes_px: Int64[np.ndarray, "n 2"], tiles: int
) -> tuple[Int64[np.ndarray, " r"], Int64[np.ndarray, " r"], Int64[np.ndarray, " r"]]:
    """Pixels (view, y, x) evenly over each view, ``tiles * TILE_PX`` each way, in tiles of neighbours."""
    side = tiles * TILE_PX
    shape = (tiles, tiles, TILE_PX, TILE_PX)
    tile_y, tile_x, y, x = np.unravel_index(np.arange(side * side), shape)
    down, across = tile_y * TILE_PX + y + 0.5, tile_x * TILE_PX + x + 0.5
    width, height = sizes_px[indices].T
    rows = (down * height[:, None] / side).astype(np.int64)
    columns = (across * width[:, None] / side).astype(np.int64)
    view = np.broadcast_to(indices[:, None], rows.shape)
    return view.reshape(-1), rows.reshape(-1), columns.reshape(-1)
