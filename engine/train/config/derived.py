"""What settings that are left to the photographs come to."""

import math

from octasplat.engine.train.config.gaussians import GaussianSettings
from octasplat.engine.train.config.loss import DEPTH_MAP_WEIGHT
from octasplat.engine.train.config.train import TrainConfig

MAX_PLANNED_ITERATIONS = 70_000
"""Where a time decides their number, see :mod:`octasplat.engine.train.loop.time_budget`."""
MIN_THOUSANDS = 5
"""Of iterations, where the photographs decide their number."""
RAY_SORT_ITERATION_RATIO = 3 / 7
"""Share of the rays that a training has time for where each ray has an order of its own."""
RAYS_PER_MIN_THOUSANDS = 3
"""Rays per pixel for each of which so many the minimum is taken once, where each ray has its own order."""
MAX_ITERATIONS, MAX_ITERATIONS_RAYS = 10_000, 3
"""At most so many iterations for so many rays per pixel."""
MIN_PIXELS_PER_GAUSSIAN = 10
"""Fewer pixels do not constrain a Gaussian: it learns the noise of the training views."""
MIN_GAUSSIANS = 10_000
"""Of small photographs, where their pixels constrain so many."""
MIN_PATCHES_ACROSS = 15
"""Patches of rays along the longest side of a view, so that each covers a small angle."""
PATCH_PIXELS_PER_GAUSSIAN_PIXEL = 6
"""Pixels that a patch spans for each pixel that a Gaussian covers, so that its rays meet the same ones."""
ITERATIONS_PER_BATCH = 4
"""Iterations of the fit of residual colors for each batch that is drawn and shaded; the others look at kept
ones again, which costs a fourth."""
KEPT_BATCHES = 256
"""So many of them, the last ones."""
RESIDUAL_ITERATION_COST = 0.17
"""Of an iteration with materials, what one of that fit takes, see ``docs/notes/materials.md``."""
GAUSSIANS_PER_REBUILD_INTERVAL = 500_000
"""Gaussians for each of which so many the interval between rebuilds is taken once more."""


def iteration_count(config: TrainConfig, training_pixels: int, valid_fraction: float = 1.0) -> int:
    """Return ``config.iterations``, or where that is 0 the number that the training pixels ask for.

    That is ``config.rays_per_pixel`` rays for each pixel, rounded to thousands of iterations, at least
    ``MIN_THOUSANDS`` or one thousand for each ray per pixel, whichever is more, and at most
    ``MAX_ITERATIONS`` for each ``MAX_ITERATIONS_RAYS`` of them. With per-ray sorting an iteration takes
    longer, so fewer rays are traced. Where only ``valid_fraction`` of the pixels shows anything, the other
    rays teach and cost little, and the count is divided by it; not with materials.

    Args:
        config: settings of the training.
        training_pixels: pixels of all training views.
        valid_fraction: share of them that shows anything.
    """
    rays_per_pixel = config.rays_per_pixel
    if uses_shared_sort(config):
        min_thousands = max(MIN_THOUSANDS, rays_per_pixel)
    else:
        if not config.materials.learn:  # their presets set rays_per_pixel for per-ray sorting already
            rays_per_pixel = max(1, round(RAY_SORT_ITERATION_RATIO * rays_per_pixel))
        min_thousands = MIN_THOUSANDS * max(1, rays_per_pixel // RAYS_PER_MIN_THOUSANDS)
    thousands = max(round(rays_per_pixel * training_pixels / config.rays_per_batch / 1000), min_thousands)
    if not config.materials.learn:
        thousands = round(thousands / valid_fraction)  # rays that show nothing cost next to no time
    max_thousands = MAX_ITERATIONS // 1000 * rays_per_pixel // MAX_ITERATIONS_RAYS
    return config.iterations or min(thousands, max_thousands) * 1000


def max_gaussian_count(config: GaussianSettings, training_pixels: int, valid_fraction: float = 1.0) -> int:
    """Return ``config.max_gaussians``, or where that is 0 what the pixels of training views can constrain.

    Of those only the share counts that shows anything, see ``MIN_PIXELS_PER_GAUSSIAN``.
    """
    if config.max_gaussians:
        return config.max_gaussians
    training_pixels = round(training_pixels * valid_fraction)
    constrained = min(training_pixels // MIN_PIXELS_PER_GAUSSIAN, MIN_GAUSSIANS)
    wanted = max(training_pixels // config.pixels_per_gaussian, constrained, 1)
    return min(wanted, config.max_gaussians_auto)


def with_depth_weight(config: TrainConfig, *, has_depth_maps: bool) -> TrainConfig:
    """Return the settings for photographs with or without depth maps: the weight of these decided."""
    if not has_depth_maps:
        weight = None
    elif config.loss.depth is None:
        weight = DEPTH_MAP_WEIGHT
    else:
        weight = config.loss.depth
    return config.model_copy(update={"loss": config.loss.model_copy(update={"depth": weight})})


def uses_shared_sort(config: TrainConfig) -> bool:
    """Return whether the rays of a patch composite in one order for a part of the training.

    Gradients by depths and normals, and a second phase, want each ray's own.
    """
    by_geometry = config.materials.learn or config.loss.depth_normal > 0 or bool(config.loss.depth)
    return config.shared_sort_until > 0 and not by_geometry and config.trace.second_phase_min is None


def ray_patch_side_px(config: TrainConfig, longest_side_px: int, pixels_per_gaussian: float) -> int:
    """Return ``config.ray_patch_side``, or where that is 0 what suits the Gaussians or the views.

    A patch is to cover a small angle, so that its rays meet the same Gaussians: what these cost once for all
    rays is most of what rays in one order cost. But rays that are too close learn the same.
    """
    if config.ray_patch_side:
        return config.ray_patch_side
    widest = max(1, round(longest_side_px / MIN_PATCHES_ACROSS))
    if not uses_shared_sort(config):
        return widest
    return min(widest, max(1, round(math.sqrt(PATCH_PIXELS_PER_GAUSSIAN_PIXEL * pixels_per_gaussian))))


def min_tile_side_px(config: TrainConfig) -> int:
    """Return the least side of tiles of pixels that are drawn from: patches for SSIM fit into them."""
    return config.ssim_patch_side if config.loss.ssim > 0 else 1


def rebuild_interval(rebuild_every: int, gaussians: int) -> int:
    """Return the iterations between rebuilds: ``rebuild_every``, as much again for each half million.

    A rebuild takes time for every Gaussian, an iteration only for those that its rays meet.
    """
    return rebuild_every * (1 + gaussians // GAUSSIANS_PER_REBUILD_INTERVAL)


def has_residual_colors(config: TrainConfig) -> bool:
    """Return whether residual colors are fitted after a training of the whole scene."""
    return config.materials.learn and bool(config.materials.residual_share)


def residual_cost_share(config: TrainConfig) -> float:
    """Return how long the fit of residual colors takes, as a share of the training before it; 0: none."""
    share = config.materials.residual_share or 0.0
    return RESIDUAL_ITERATION_COST * share if has_residual_colors(config) else 0.0


def residual_iteration_count(config: TrainConfig, iterations: int) -> int:
    """Return how many iterations fit residual colors after a training of so many; 0: there are none."""
    if not has_residual_colors(config):
        return 0
    return round((config.materials.residual_share or 0.0) * iterations)
