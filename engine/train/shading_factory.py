"""The shading model that a configuration asks for."""

from octasplat.engine.shading.background import LearntBackground
from octasplat.engine.shading.deferred import Deferred
from octasplat.engine.shading.depth_normal_model import Flattening
from octasplat.engine.shading.exposure import Exposures
from octasplat.engine.shading.plain import PLAIN
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.train.config import BACKGROUND_SMOOTHNESS, TrainConfig


def make_shading(config: TrainConfig, views: int, extent_world: float) -> ShadingModel:
    """The model, untrained, for a dataset of so many views and that extent."""
    inner: ShadingModel = PLAIN
    if config.materials.learn:  # it holds normals and depths together itself
        inner = make_deferred(config, extent_world)
    elif config.loss.depth_normal > 0:
        inner = Flattening(config.loss.depth_normal)
    if config.background == "learnt":
        inner = LearntBackground(
            config.background_height,
            rate=config.lr.background,
            decay=config.lr.decay,
            even_weight=BACKGROUND_SMOOTHNESS,
            inner=inner,
        )
    if config.exposure is True:
        return Exposures(views, rate=config.lr.exposure, decay=config.lr.decay, inner=inner)
    return inner


def make_deferred(config: TrainConfig, extent_world: float) -> Deferred:
    """The model of materials, with an environment of which nothing is known yet."""
    return Deferred(
        config.materials,
        extent_world=extent_world,
        sided=config.trace.flip_normal_cos > 0,
    )


def exposures_of(shading: ShadingModel) -> Exposures | None:
    """The exposures that a shading model learns."""
    return shading if isinstance(shading, Exposures) else None


def exposed_as(shading: ShadingModel, view: int) -> ShadingModel:
    """What develops a view of the dataset, trained on or held out, as exposed as that is known to be."""
    exposures = exposures_of(shading)
    return shading if exposures is None else exposures.shown_as(view)


def background_of(shading: ShadingModel) -> LearntBackground | None:
    """The learnt background that a shading model is, or has inside."""
    if isinstance(shading, Exposures):
        return background_of(shading.inner)
    return shading if isinstance(shading, LearntBackground) else None


def deferred_of(shading: ShadingModel) -> Deferred | None:
    """The model of materials that a shading model is, or has inside."""
    if isinstance(shading, Exposures):
        return deferred_of(shading.inner)
    return shading if isinstance(shading, Deferred) else None
