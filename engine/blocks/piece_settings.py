"""Settings of the trainings of a run in blocks, made from those of the run."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.train.config import (
    LearningRates,
    McmcConfig,
    TrainConfig,
    iteration_count,
    max_gaussian_count,
    uses_shared_sort,
)

if TYPE_CHECKING:
    from octasplat.engine.runs.config import ReconstructionConfig

AUTO_VIEWS = 500
"""Most training views of each block, on average, where the number of blocks is automatic."""
MARGIN = 0.1
"""Margin around a block's core that is trained with it, of the distance over which what is seen spreads."""
FINISHED_MARGIN = 0.02
"""The same where all blocks are finished together, which trains both sides of a cut: what a block learns in
its margin is dropped, and takes rays that its core would use."""
COARSE_ITERATIONS, COARSE_GAUSSIANS = 2_500, 50_000
"""Most of the coarse scene, as of the preset fast."""
COARSE_ITERATION_FRACTION, COARSE_GAUSSIAN_FRACTION = 1 / 2, 1 / 4
"""Most of it where the run says how many: of the iterations of a block, and of all Gaussians, as photographs
of half the size have a quarter of the pixels."""
MIN_COARSE_GAUSSIANS = 4_000
"""Which are soon trained; fewer where the whole scene has fewer."""
MIN_COARSE_SIDE_PX = 200
COARSE_RAY_FRACTION = 1 / 2
"""Rays of an iteration of the coarse scene, of those of the run."""
BLOCK_GROWTH = 1.0
"""Growth of blocks at each interval: the coarse scene has few Gaussians, and soon many are to learn."""
POLISH_FRACTION = 0.1
"""Iterations of the polish, of those that an ordinary training of its pixels takes."""
DECAYING_RATES = ("quat", "log_scale", "opacity", "color", "exposure", "background")
"""Rates that fall to a share of their first size."""
FINISH_FROM = 0.35
"""Share of the schedule of a training that blocks go through where all of them are finished together."""
FIRST_PART = 1 / 2
"""Iterations of such a block, of those that it would take by itself."""
FINISH_FRACTION = 5 / 3
"""Iterations of finishing all blocks together, of those of the blocks."""


def fewest_blocks(
    config: TrainConfig,
    views: int,
    training_pixels: int,
    most_gaussians: int | None,
    valid_fraction: float = 1.0,
) -> int:
    """Return the fewest blocks for so many training views and pixels of them.

    Args:
        config: settings of the training.
        views: number of training views.
        training_pixels: of all of them.
        most_gaussians: of any block with its margin; None for no such limit.
        valid_fraction: share of the pixels that shows anything.
    """
    by_views = math.ceil(views / AUTO_VIEWS)
    if most_gaussians is None:
        return by_views
    wanted = max_gaussian_count(config, training_pixels, valid_fraction)
    if wanted <= most_gaussians:
        return by_views
    # blocks overlap by their margins
    return max(by_views, math.ceil(wanted * (1 + 2 * MARGIN) / most_gaussians))


def require_blocks_possible(config: "ReconstructionConfig") -> None:
    """Refuse settings with which a scene is not trained in blocks.

    Raises:
        ConfigError: one of them is on.
    """
    unsupported = {
        "materials": config.train.materials.learn,
        "refine_poses": config.train.refine_poses,
        "exclude_outlier_views": config.train.exclude_outlier_views,
        "loss.free_space": config.train.loss.free_space > 0,
        "a time budget (--minutes)": config.minutes is not None,
        "a region (--region)": config.region is not None,
    }
    if found := [name for name, is_on in unsupported.items() if is_on]:
        raise ConfigError(
            f"A scene is not trained in blocks with {' or '.join(found)}; leave that out, or --blocks."
        )


def coarse_side_px(longest_side_px: int) -> int:
    """Return the longest side of the photographs of the coarse scene: half of the working size."""
    return min(longest_side_px, max(longest_side_px // 2, MIN_COARSE_SIDE_PX))


def coarse_settings(config: TrainConfig) -> TrainConfig:
    """Return the settings of the coarse scene."""
    iterations = math.ceil(COARSE_ITERATION_FRACTION * config.iterations) or COARSE_ITERATIONS
    most_gaussians = math.ceil(COARSE_GAUSSIAN_FRACTION * config.max_gaussians)  # 0 asks the pixels
    most_gaussians = max(most_gaussians, min(MIN_COARSE_GAUSSIANS, config.max_gaussians))
    return config.model_copy(
        update={
            "iterations": min(iterations, COARSE_ITERATIONS),
            "rays_per_batch": _coarse_rays(config),
            "shared_sort_until": 1.0 if uses_shared_sort(config) else 0.0,
            "max_gaussians": min(most_gaussians, COARSE_GAUSSIANS),
            "max_gaussians_auto": min(config.max_gaussians_auto, COARSE_GAUSSIANS),
        }
    )


def _coarse_rays(config: TrainConfig) -> int:
    """Return the rays of an iteration of the coarse scene; patches for SSIM need all of them."""
    return math.ceil((1 if config.loss.ssim > 0 else COARSE_RAY_FRACTION) * config.rays_per_batch)


def block_settings(
    config: TrainConfig, share: float, most_gaussians: int | None, *, is_finished_later: bool
) -> TrainConfig:
    """Return the settings of a block; exposures and background are those of the coarse scene.

    Args:
        config: of the run; its iterations hold for each block, its most Gaussians for all of them.
        share: of the whole scene that the block with its margin makes.
        most_gaussians: of any block; None for no such limit.
        is_finished_later: whether it goes only through the first part of a training's schedule, see
            :func:`finish_settings`.
    """
    if is_finished_later:
        config = _first_part(config)
    most = round(config.max_gaussians * share)
    most_auto = config.max_gaussians_auto
    if most_gaussians is not None:
        most, most_auto = min(most, most_gaussians), min(most_auto, most_gaussians)
    densify = config.densify
    if isinstance(densify, McmcConfig):
        densify = densify.model_copy(update={"growth": max(densify.growth, BLOCK_GROWTH)})
    if config.max_gaussians:  # 0 asks the photographs' pixels
        most = max(most, 1)
    return config.model_copy(
        update={
            "max_gaussians": most,
            "max_gaussians_auto": most_auto,
            "densify": densify,
            "lr": config.lr.model_copy(update={"exposure": 0.0, "background": 0.0}),
        }
    )


def fits_together(
    config: TrainConfig, training_pixels: int, most_gaussians: int | None, valid_fraction: float = 1.0
) -> bool:
    """Return whether one training may hold the Gaussians of all blocks, so that they are finished together.

    Args:
        config: of the run.
        training_pixels: of all training views.
        most_gaussians: of any training; None for the most that the settings allow the whole scene.
        valid_fraction: share of the pixels that shows anything.
    """
    unlimited = config.model_copy(update={"max_gaussians_auto": max(training_pixels, 1)})
    wanted = max_gaussian_count(unlimited, training_pixels, valid_fraction)
    return wanted <= (most_gaussians or config.max_gaussians or config.max_gaussians_auto)


def block_margin(*, is_finished_later: bool) -> float:
    """Return the margin of blocks, of the distance over which what is seen spreads.

    Args:
        is_finished_later: whether all blocks are finished together, see :func:`fits_together`.
    """
    return FINISHED_MARGIN if is_finished_later else MARGIN


def finish_settings(config: TrainConfig, iterations: int, of_blocks: Sequence[int] = ()) -> TrainConfig:
    """Return the settings of finishing all blocks together: the rest of the schedule that they began.

    Exposures and background are learnt again.

    Args:
        config: of the run.
        iterations: of the finish.
        of_blocks: iterations of each block; 0 of those that are not trained.
    """
    lr = _rates_of_blocks(_first_part(config), of_blocks)
    # each rate goes on from where the blocks' has ended
    begun = {name: getattr(lr, name) * lr.decay for name in DECAYING_RATES}
    rates = {**begun, "mean": lr.mean_final, "mean_final": config.lr.mean_final}
    densify = config.densify
    moves: dict[str, object] = {"start": 0, "stop_fraction": _share_of_rest(densify.stop_fraction)}
    if isinstance(densify, McmcConfig):
        rounds = densify.relocate_low_weight_rounds
        moves["relocate_low_weight_rounds"] = max(1, rounds - _rounds_of_first_part(rounds))
    return config.model_copy(
        update={
            "iterations": iterations,
            "densify_from_iter": 0,
            "densify": densify.model_copy(update=moves),
            "opacity_decay": None,
            "early_stopping_db": 0.0,
            "shared_sort_until": _share_of_rest(config.shared_sort_until),
            "weight_averaging_start": _share_of_rest(config.weight_averaging_start),
            "lr": lr.model_copy(update={**rates, "decay": config.lr.decay / lr.decay, "scale_after": 0}),
        }
    )


def _share_of_rest(share: float) -> float:
    """Return where ``share`` of the whole schedule lies in what is left of it after ``FINISH_FROM``."""
    return max(0.0, (share - FINISH_FROM) / (1 - FINISH_FROM))


def _rounds_of_first_part(rounds: int) -> int:
    """Return how many of so many rounds blocks go through, so that they are as far apart."""
    return max(1, round(FINISH_FROM * rounds))


def block_iterations(
    config: TrainConfig, pixels: int, valid_fraction: float = 1.0, *, is_finished_later: bool
) -> int:
    """Return the iterations of a block.

    Args:
        config: of the block, see :func:`block_settings`.
        pixels: that it is trained on, those drawn less often counted less.
        valid_fraction: share of them that shows anything.
        is_finished_later: whether all blocks are finished together, see :func:`fits_together`.
    """
    count = iteration_count(config, pixels, valid_fraction)
    return max(1, round(FIRST_PART * count)) if is_finished_later else count


def finish_iterations(of_blocks: Sequence[int]) -> int:
    """Return the iterations of finishing all blocks together, after so many of each."""
    return max(1, round(FINISH_FRACTION * sum(of_blocks)))


def _first_part(config: TrainConfig) -> TrainConfig:
    """Return the settings of a training that ends where the schedule is at ``FINISH_FROM``."""
    lr, densify = config.lr, config.densify
    mean_final = lr.mean * (lr.mean_final / lr.mean) ** FINISH_FROM
    fewer: dict[str, object] = {"stop_fraction": min(1.0, densify.stop_fraction / FINISH_FROM)}
    if isinstance(densify, McmcConfig):
        fewer["relocate_low_weight_rounds"] = _rounds_of_first_part(densify.relocate_low_weight_rounds)
    return config.model_copy(
        update={
            "shared_sort_until": min(1.0, config.shared_sort_until / FINISH_FROM),
            "weight_averaging_start": min(1.0, config.weight_averaging_start / FINISH_FROM),
            "early_stopping_db": 0.0,
            "densify": densify.model_copy(update=fewer),
            "lr": lr.model_copy(update={"decay": lr.decay**FINISH_FROM, "mean_final": mean_final}),
        }
    )


def _rates_of_blocks(config: TrainConfig, of_blocks: Sequence[int]) -> LearningRates:
    """Return the rates that blocks of so many iterations had in the mean: those of long ones are smaller."""
    trained = [length for length in of_blocks if length]
    return config.lr.scaled_for(round(sum(trained) / max(len(trained), 1)))


def polish_settings(config: TrainConfig, iterations: int, of_blocks: Sequence[int] = ()) -> TrainConfig:
    """Return the settings of the polish: the last, small steps, and nothing is added or moved elsewhere.

    Args:
        config: of the run.
        iterations: of the polish.
        of_blocks: iterations of each block; 0 of those that are not trained.
    """
    lr = _rates_of_blocks(config, of_blocks)
    last = {name: getattr(lr, name) * lr.decay for name in ("quat", "log_scale", "opacity", "color")}
    rates = {**last, "mean": lr.mean_final, "decay": 1.0, "exposure": 0.0, "background": 0.0}
    return config.model_copy(
        update={
            "iterations": iterations,
            "densify_from_iter": iterations + 1,
            "opacity_decay": None,
            "early_stopping_db": 0.0,
            "lr": lr.model_copy(update={**rates, "scale_after": 0}),
        }
    )
