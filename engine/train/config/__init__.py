"""All settings of training with their defaults, and the presets; one module for each subject.

Imports neither torch nor numba.
"""

from octasplat.engine.train.config.densify import McmcConfig, RedisplatsConfig
from octasplat.engine.train.config.derived import (
    ITERATIONS_PER_BATCH,
    KEPT_BATCHES,
    MAX_PLANNED_ITERATIONS,
    has_residual_colors,
    iteration_count,
    max_gaussian_count,
    min_tile_side_px,
    ray_patch_side_px,
    rebuild_interval,
    residual_cost_share,
    residual_iteration_count,
    uses_shared_sort,
    with_depth_weight,
)
from octasplat.engine.train.config.learning_rates import LearningRates
from octasplat.engine.train.config.loss import SURFACE_DEPTH_NORMAL_WEIGHT, LossWeights
from octasplat.engine.train.config.photographs import (
    BACKGROUND_SMOOTHNESS,
    OUTLIER_VIEWS_FROM,
    VISIBILITY_RAY_MARGIN,
    Background,
    PhotographSettings,
)
from octasplat.engine.train.config.presets import preset, with_materials
from octasplat.engine.train.config.train import TrainConfig

__all__ = [
    "BACKGROUND_SMOOTHNESS",
    "ITERATIONS_PER_BATCH",
    "KEPT_BATCHES",
    "MAX_PLANNED_ITERATIONS",
    "OUTLIER_VIEWS_FROM",
    "SURFACE_DEPTH_NORMAL_WEIGHT",
    "VISIBILITY_RAY_MARGIN",
    "Background",
    "LearningRates",
    "LossWeights",
    "McmcConfig",
    "PhotographSettings",
    "RedisplatsConfig",
    "TrainConfig",
    "has_residual_colors",
    "iteration_count",
    "max_gaussian_count",
    "min_tile_side_px",
    "preset",
    "ray_patch_side_px",
    "rebuild_interval",
    "residual_cost_share",
    "residual_iteration_count",
    "uses_shared_sort",
    "with_depth_weight",
    "with_materials",
]
