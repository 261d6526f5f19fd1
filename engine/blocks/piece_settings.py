"""Settings of the trainings of a run in blocks, made from those of the run."""

import math

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.train.config import TrainConfig

COARSE_ITERATIONS, COARSE_GAUSSIANS = 2_500, 50_000
"""Most of the coarse scene, as of the preset fast."""
COARSE_ITERATION_FRACTION, COARSE_GAUSSIAN_FRACTION = 1 / 2, 1 / 4
"""Most of it where the run says how many: of the iterations of a block, and of all Gaussians, as photographs
of half the size have a quarter of the pixels."""
MIN_COARSE_GAUSSIANS = 4_000
"""Which are soon trained; fewer where the whole scene has fewer."""
MIN_COARSE_SIDE_PX = 200
POLISH_FRACTION = 0.1
"""Iterations of the polish, of those that an ordinary training of its pixels takes."""


def require_blocks_possible(config: TrainConfig, *, has_time_budget: bool) -> None:
    """Refuse settings with which a scene is not trained in blocks.

    Raises:
        ConfigError: one of them is on.
    """
    unsupported = {
        "materials": config.materials.learn,
        "refine_poses": config.refine_poses,
        "exclude_outlier_views": config.exclude_outlier_views,
        "loss.free_space": config.loss.free_space > 0,
        "a time budget (--minutes)": has_time_budget,
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
            "max_gaussians": min(most_gaussians, COARSE_GAUSSIANS),
            "max_gaussians_auto": min(config.max_gaussians_auto, COARSE_GAUSSIANS),
        }
    )


def block_settings(config: TrainConfig, share: float, most_gaussians: int | None) -> TrainConfig:
    """Return the settings of a block; exposures and background are those of the coarse scene.

    Args:
        config: of the run; its iterations hold for each block, its most Gaussians for all of them.
        share: of the whole scene that the block with its margin makes.
        most_gaussians: of any block; None for no such limit.
    """
    most = round(config.max_gaussians * share)
    most_auto = config.max_gaussians_auto
    if most_gaussians is not None:
        most, most_auto = min(most, most_gaussians), min(most_auto, most_gaussians)
    if config.max_gaussians:  # 0 asks the photographs' pixels
        most = max(most, 1)
    return config.model_copy(
        update={
            "max_gaussians": most,
            "max_gaussians_auto": most_auto,
            "lr": config.lr.model_copy(update={"exposure": 0.0, "background": 0.0}),
        }
    )


def polish_settings(config: TrainConfig, iterations: int) -> TrainConfig:
    """Return the settings of the polish: the last, small steps, and nothing is added or moved elsewhere."""
    lr = config.lr
    last = {name: getattr(lr, name) * lr.decay for name in ("quat", "log_scale", "opacity", "color")}
    rates = {**last, "mean": lr.mean_final, "decay": 1.0, "exposure": 0.0, "background": 0.0}
    return config.model_copy(
        update={
            "iterations": iterations,
            "densify_from_iter": iterations + 1,
            "early_stopping_db": 0.0,
            "lr": lr.model_copy(update=rates),
        }
    )
