"""Batches of rays: random pixels over all training views, mixed with whole square patches for SSIM."""

import math
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Int64

from octasplat.engine.core.color import composite_over
from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.shading.ray_patches import RayPatches
from octasplat.engine.shading.recipes import material_shading
from octasplat.engine.train.config import (
    VISIBILITY_RAY_MARGIN,
    Background,
    TrainConfig,
    max_gaussian_count,
    ray_patch_side_px,
)
from octasplat.engine.train.sampling.pixel_sampler import (
    TrainingData,
    has_known_distances,
    known_distances,
    pixel_sampler,
    valid_pixel_fraction,
)
from octasplat.engine.train.sampling.visibility_rays import ObservedPoints, VisibilityRays

TILE_PX = 8


@dataclass(frozen=True)
class Batch:
    """Rays and what the photographs show there.

    The last ``ssim_patch_count * side * side`` rays are patches, row-major one after another.
    ``ray_patches`` says which of the others form patches. ``background_srgb`` lies
    behind both the Gaussians and photographs with alpha. ``visibility_rays`` end before points that views
    show. ``known_distances`` are those of the surface along the rays by depth maps, world units, 0 where
    unknown. ``edge_batch`` has further rays, for the term of the loss for edges.
    """

    rays: RayBatch
    rgb_srgb: Float32[np.ndarray, "r 3"]
    alpha: Float32[np.ndarray, " r"]
    weight: Float32[np.ndarray, " r"]
    view: Int64[np.ndarray, " r"]
    ssim_patch_count: int
    patch_side: int
    background_srgb: Float32[np.ndarray, "3"]
    visibility_rays: RayBatch | None = None
    ray_patches: RayPatches | None = None
    known_distances: Float32[np.ndarray, " r"] | None = None
    edge_batch: "Batch | None" = None

    @cached_property
    def target_srgb(self) -> Float32[np.ndarray, "r 3"]:
        """Return the photographs' colors over the background."""
        if self.alpha.min(initial=1) >= 1:  # most photographs are opaque
            return self.rgb_srgb
        return composite_over(self.rgb_srgb, self.alpha, self.background_srgb)


@dataclass(frozen=True)
class BatchOptions:
    """Options of the drawing of batches.

    Attributes:
        rays_per_batch: number of rays of a batch.
        background: what lies behind everything.
        ray_patch_rays: rays of a patch of neighbouring pixels, a square number; 1 scatters them.
        ray_patch_side_px: side of such a patch, in pixels.
        ssim_patch_fraction: share of the rays that comes in whole patches for SSIM; None where the
            loss has no such term.
        ssim_patch_side_px: side of a whole patch, in pixels.
        visibility_ray_fraction: visibility rays beside each batch, of its rays; 0 where the loss has no term
            for them.
        reads_depths: whether the loss has a term for depth maps.
        has_edge_rays: whether the loss has a term for edges, which asks for harmonics that learn the shaded
            colors; those of other recipes show the matt part alone, or nothing of mirrors.
    """

    rays_per_batch: int
    background: Background
    ray_patch_rays: int
    ray_patch_side_px: int
    ssim_patch_fraction: float | None
    ssim_patch_side_px: int
    visibility_ray_fraction: float
    reads_depths: bool = False
    has_edge_rays: bool = False

    @classmethod
    def from_config(cls, config: TrainConfig, dataset: TrainingData) -> "BatchOptions":
        """Return the options that a configuration asks for with these photographs.

        Raises:
            DatasetError: masks or alpha leave nothing of the training photographs.
        """
        sampler = pixel_sampler(dataset, dataset.train_indices)
        pixels, valid = sampler.pixel_count, valid_pixel_fraction(dataset)
        pixels_per_gaussian = pixels * valid / max_gaussian_count(config, pixels, valid)
        return cls(
            rays_per_batch=config.rays_per_batch,
            background=config.background,
            ray_patch_rays=config.ray_patch_rays,
            ray_patch_side_px=ray_patch_side_px(config, sampler.longest_side_px, pixels_per_gaussian),
            ssim_patch_fraction=config.ssim_patch_fraction if config.loss.ssim > 0 else None,
            ssim_patch_side_px=config.ssim_patch_side,
            visibility_ray_fraction=config.visibility_ray_fraction if config.loss.free_space > 0 else 0.0,
            reads_depths=bool(config.loss.depth),
            has_edge_rays=bool(config.loss.edges)
            and config.materials.learn
            and material_shading(config.materials.recipe).harmonics_are_shaded,
        )


class BatchSource:
    """Draws the batches of a training.

    Where the loss has an SSIM term, some of the rays come as whole patches; the others come in patches of
    neighbours, as far as that goes, and singly where such a patch is one ray.

    Args:
        dataset: the photographs.
        options: sizes and shares.
        observed: the photographs at the poses of the model, which visibility rays keep; None takes
            ``dataset``.

    Raises:
        ConfigError: the SSIM term would have no patch, or a background is to be learnt where none is shown.
    """

    def __init__(
        self, dataset: TrainingData, options: BatchOptions, *, observed: TrainingData | None = None
    ) -> None:
        if options.background == "learnt" and dataset.has_alpha:
            raise ConfigError(
                "These photographs have alpha, so that they show no background; leave background=learnt out."
            )
        self._dataset = dataset
        self._options = options
        self.sampler = pixel_sampler(dataset, dataset.train_indices)
        self._ssim_patches = self._patch_count()
        self._reads_depths = options.reads_depths and has_known_distances(dataset)
        self._visibility_rays: VisibilityRays | None = None
        needs_visibility_rays = options.visibility_ray_fraction > 0
        observed = dataset if observed is None else observed
        if needs_visibility_rays and isinstance(observed, ObservedPoints) and len(observed.points):
            self._visibility_rays = VisibilityRays.from_dataset(observed, VISIBILITY_RAY_MARGIN)

    def exclude_views(self, views: Int64[np.ndarray, " m"]) -> None:
        """Draw nothing of these views any more."""
        remaining = np.setdiff1d(self._dataset.train_indices, views)
        self.sampler = pixel_sampler(self._dataset, remaining)
        if self._visibility_rays is not None:
            self._visibility_rays = self._visibility_rays.exclude_views(views)

    def draw(self, rng: np.random.Generator, index: int = 0) -> Batch:
        """Draw the next batch, after ``index`` others."""
        batch = self._draw(rng, index)
        if self._options.has_edge_rays:
            # counted backwards, so that they look elsewhere than the batch itself
            edge_batch = self._draw(rng, -1 - index)
            _ = edge_batch.target_srgb
            batch = replace(batch, edge_batch=edge_batch)
        _ = batch.target_srgb  # worked out here, as the next batch is drawn beside the iteration
        return batch

    def _draw(self, rng: np.random.Generator, index: int) -> Batch:
        options, sampler, side = self._options, self.sampler, self._options.ssim_patch_side_px
        free_count = options.rays_per_batch - self._ssim_patches * side**2
        patch_count = free_count // options.ray_patch_rays if options.ray_patch_rays > 1 else 0
        single_count = free_count - patch_count * options.ray_patch_rays
        pixels, ray_patches = [sampler.pixels(rng, single_count)], None
        if patch_count:
            ray_patches = RayPatches(single_count, patch_count, math.isqrt(options.ray_patch_rays))
            pixels.append(
                sampler.ray_patches(
                    rng, patch_count, rays=options.ray_patch_rays, side=options.ray_patch_side_px, index=index
                )
            )
        if self._ssim_patches:
            pixels.append(sampler.patches(rng, self._ssim_patches, side))
        view, y, x = (np.concatenate(parts) for parts in zip(*pixels, strict=True))
        rays = self._dataset.rays(view, y, x)
        rgb, alpha, weight = self._dataset.pixels(view, y, x)
        distances = None
        if self._reads_depths:  # what is masked may hide the surface
            shown = (weight > 0) & (alpha > 0)
            distances = np.where(shown, known_distances(self._dataset, view, y, x), np.float32(0.0))
        background = self._background_colors(rng)
        visibility_rays = None
        if self._visibility_rays is not None and len(self._visibility_rays):
            visibility_rays = self._visibility_rays.draw(
                rng, max(1, round(options.visibility_ray_fraction * options.rays_per_batch))
            )
        return Batch(
            rays=rays,
            rgb_srgb=rgb,
            alpha=alpha,
            weight=weight,
            view=view,
            ssim_patch_count=self._ssim_patches,
            patch_side=side,
            background_srgb=background,
            visibility_rays=visibility_rays,
            ray_patches=ray_patches,
            known_distances=distances,
        )

    def _patch_count(self) -> int:
        options, side = self._options, self._options.ssim_patch_side_px
        if options.ssim_patch_fraction is None:
            return 0
        smallest = self.sampler.smallest_side_px
        if smallest < side:
            raise ConfigError(
                f"loss.ssim compares patches of {side} x {side} pixels, but a training view is only "
                f"{smallest} pixels wide or high; lower ssim_patch_side (16 at least), or set loss.ssim to 0."
            )
        count = min(
            # no more patches than rays, whatever the share says
            round(options.rays_per_batch * options.ssim_patch_fraction / side**2),
            options.rays_per_batch // side**2,
        )
        if count == 0:
            raise ConfigError(
                f"loss.ssim compares patches of {side} x {side} pixels, but a share of "
                f"{options.ssim_patch_fraction:g} of {options.rays_per_batch} rays makes none; raise "
                "rays_per_batch or "
                "ssim_patch_fraction, or set loss.ssim to 0."
            )
        return count

    def _background_colors(self, rng: np.random.Generator) -> Float32[np.ndarray, "3"]:
        name: Background = self._options.background
        if name == "auto":
            # photographs with alpha show none: a random one keeps Gaussians from imitating it
            name = "random" if self._dataset.has_alpha else "black"
        if name == "random":
            return rng.random(3, dtype=np.float32)
        return evaluation_background(name)


class PrefetchedBatches:
    """Draw batches; the next one in the background where it is prefetched.

    The generator is drawn from in the order of the batches either way, so that they are the same ones.

    Args:
        source: where batches come from.
    """

    def __init__(self, source: BatchSource) -> None:
        self._source = source
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="batch")
        self._next: Future[Batch] | None = None

    def __enter__(self) -> "PrefetchedBatches":
        return self

    def __exit__(self, *_error: object) -> None:
        self._worker.shutdown()

    def prefetch(self, rng: np.random.Generator, index: int) -> None:
        """Begin the next batch; until :meth:`draw` gives it nothing else may draw from ``rng``."""
        self._next = self._worker.submit(self._source.draw, rng, index)

    def draw(self, rng: np.random.Generator, index: int) -> Batch:
        """Return the batch after ``index`` others, begun or not."""
        begun, self._next = self._next, None
        return self._source.draw(rng, index) if begun is None else begun.result()


def evaluation_background(background: Background) -> Float32[np.ndarray, "3"]:
    """Return the color behind everything when views are compared: white if asked for, else black."""
    return np.full(3, 1.0 if background == "white" else 0.0, np.float32)


def grid_pixels(
    indices: Int64[np.ndarray, " v"], sizes_px: Int64[np.ndarray, "n 2"], tiles: int
) -> tuple[Int64[np.ndarray, " r"], Int64[np.ndarray, " r"], Int64[np.ndarray, " r"]]:
    """Return pixels (view, y, x) evenly over each view, ``tiles * TILE_PX`` each way, tile by tile."""
    side = tiles * TILE_PX
    shape = (tiles, tiles, TILE_PX, TILE_PX)
    tile_y, tile_x, y, x = np.unravel_index(np.arange(side * side), shape)
    down, across = tile_y * TILE_PX + y + 0.5, tile_x * TILE_PX + x + 0.5
    width, height = sizes_px[indices].T
    rows = (down * height[:, None] / side).astype(np.int64)
    columns = (across * width[:, None] / side).astype(np.int64)
    view = np.broadcast_to(indices[:, None], rows.shape)
    return view.reshape(-1), rows.reshape(-1), columns.reshape(-1)
