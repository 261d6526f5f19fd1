"""The exchangeable parts that a configuration asks for."""

from engine.shading.exposure import Exposures
from engine.shading.plain import PLAIN
from engine.shading.protocol import ShadingModel
from engine.trace.cpu import CpuTracer
from engine.trace.protocol import Tracer
from engine.train.config import TrainConfig, trace_settings


def make_tracer(config: TrainConfig, extent: float, *, threads: int) -> Tracer:
    """The tracer of a training; boxes leave room for what moves between rebuilds."""
    return CpuTracer(trace_settings(config, extent), threads=threads, box_padding=config.box_padding)


def make_shading(config: TrainConfig, views: int) -> ShadingModel:
    """The shading model, untrained, for a dataset of so many views."""
    if config.exposure:
        return Exposures(views, rate=config.rates.exposure, decay=config.rates.decay)
    return PLAIN
