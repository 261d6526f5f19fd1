"""Batches of rays: random pixels over all training views, mixed with square patches for SSIM."""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Int64

from engine.rays import RayBatch


@runtime_checkable
class Pixels(Protocol):
    """What training needs of a dataset (see :class:`engine.scene.Dataset`)."""

    def rays(
        self, view: Int64[np.ndarray, " r"], y: Int64[np.ndarray, " r"], x: Int64[np.ndarray, " r"]
    ) -> RayBatch:
        """Unit rays of pixels."""
        ...

    def pixels(
        self, view: Int64[np.ndarray, " r"], y: Int64[np.ndarray, " r"], x: Int64[np.ndarray, " r"]
    ) -> tuple[Float32[np.ndarray, "r 3"], Float32[np.ndarray, " r"], Float32[np.ndarray, " r"]]:
        """Straight display colour, alpha, and weight (0 where masked) of pixels."""
        ...


@dataclass(frozen=True)
class Batch:
    """Rays and what the photographs show there.

    The last ``patches * side * side`` rays are patches, row-major one after another.
    """

    rays: RayBatch
    rgb_srgb: Float32[np.ndarray, "r 3"]
    alpha: Float32[np.ndarray, " r"]
    weight: Float32[np.ndarray, " r"]
    view: Int64[np.ndarray, " r"]
    patches: int
    side: int


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
        self, rng: np.random.Generator, count: int, *, rays: int, side: int
    ) -> tuple[Int64[np.ndarray, " r"], Int64[np.ndarray, " r"], Int64[np.ndarray, " r"]]:
        """``rays`` pixels (a square number) in each of ``count`` windows of about ``side`` x ``side`` pixels.

        A window is a grid of cells, one random pixel in each. What sticks out of its view is folded back,
        so that every pixel is about as likely as any other.
        """
        areas = np.diff(self._ends, prepend=0)
        which = rng.choice(len(self._views), size=count, p=areas / areas.sum())
        width, height = self._sizes[which].T
        cells = math.isqrt(rays)
        cell = max(1, round(side / cells))
        rows, columns = np.divmod(np.arange(rays), cells)
        left = rng.integers(-(cell * cells // 2), width - cell * cells // 2)
        top = rng.integers(-(cell * cells // 2), height - cell * cells // 2)
        y = top[:, None] + rows * cell + rng.integers(0, cell, (count, rays))
        x = left[:, None] + columns * cell + rng.integers(0, cell, (count, rays))
        view = np.broadcast_to(self._views[which][:, None], x.shape)
        return view.reshape(-1), _fold(y, height[:, None]).reshape(-1), _fold(x, width[:, None]).reshape(-1)

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


def _fold(position: Int64[np.ndarray, "w r"], size: Int64[np.ndarray, "w 1"]) -> Int64[np.ndarray, "w r"]:
    """Positions mirrored at 0 and ``size`` until they lie between."""
    period = np.mod(position, 2 * size)
    return np.minimum(period, 2 * size - 1 - period)


def draw_batch(
    dataset: Pixels,
    sampler: PixelSampler,
    rng: np.random.Generator,
    *,
    rays: int,
    window_rays: int,
    window_side: int,
    patch_fraction: float,
    side: int,
) -> Batch:
    """``rays`` rays, of which about ``patch_fraction`` come as patches (none where a view is too small).

    The others come in windows of ``window_rays``, as far as that goes, and one by one where it is 1.
    """
    patches = min(round(rays * patch_fraction / side**2), rays // side**2)
    if sampler.smallest_side_px < side:
        patches = 0
    loose = rays - patches * side**2
    windows = loose // window_rays if window_rays > 1 else 0
    view, y, x = sampler.pixels(rng, loose - windows * window_rays)
    if windows:
        more = sampler.windows(rng, windows, rays=window_rays, side=window_side)
        view, y, x = (np.concatenate(pair) for pair in zip((view, y, x), more, strict=True))
    if patches:
        extra = sampler.patches(rng, patches, side)
        view, y, x = (np.concatenate(pair) for pair in zip((view, y, x), extra, strict=True))
    rgb, alpha, weight = dataset.pixels(view, y, x)
    return Batch(dataset.rays(view, y, x), rgb, alpha, weight, view, patches, side)
