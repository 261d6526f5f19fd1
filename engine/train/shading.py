"""The shading model that a configuration asks for."""

from engine.shading.exposure import Exposures
from engine.shading.plain import PLAIN
from engine.shading.protocol import ShadingModel
from engine.train.config import TrainConfig


def make_shading(config: TrainConfig, views: int) -> ShadingModel:
    """The model, untrained, for a dataset of so many views."""
    if config.exposure:
        return Exposures(views, rate=config.rates.exposure, decay=config.rates.decay)
    return PLAIN
