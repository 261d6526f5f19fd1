"""All settings of training with their defaults, and the presets; one module for each subject.

Imports neither torch nor numba.
"""

from octasplat.engine.train.config.densify import McmcConfig, PaperConfig
from octasplat.engine.train.config.derived import (
    MOST_PLANNED_ITERATIONS,
    in_one_order,
    iteration_count,
    most_gaussians,
    rebuild_interval,
    window_side_px,
)
from octasplat.engine.train.config.learning_rates import LearningRates
from octasplat.engine.train.config.loss import FOR_SURFACE, LossWeights
from octasplat.engine.train.config.photographs import (
    BACKGROUND_SMOOTHNESS,
    MISFITS_AFTER,
    SIGHT_LINE_MARGIN,
    Background,
    PhotographSettings,
)
from octasplat.engine.train.config.presets import preset, with_materials
from octasplat.engine.train.config.train import TrainConfig

__all__ = [
    "BACKGROUND_SMOOTHNESS",
    "FOR_SURFACE",
    "MISFITS_AFTER",
    "MOST_PLANNED_ITERATIONS",
    "SIGHT_LINE_MARGIN",
    "Background",
    "LearningRates",
    "LossWeights",
    "McmcConfig",
    "PaperConfig",
    "PhotographSettings",
    "TrainConfig",
    "in_one_order",
    "iteration_count",
    "most_gaussians",
    "preset",
    "rebuild_interval",
    "window_side_px",
    "with_materials",
]
