"""The shading model that a configuration asks for."""

from octasplat.engine.shading.background import LearnedBackground
from octasplat.engine.shading.deferred import DeferredShading
from octasplat.engine.shading.depth_normal_model import DepthNormalShading
from octasplat.engine.shading.exposure import ExposureModel
from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.train.config import BACKGROUND_SMOOTHNESS, TrainConfig


def make_shading(config: TrainConfig, views: int, extent_world: float) -> ShadingModel:
    """The model, untrained, for a dataset of so many views and that extent."""
    inner: ShadingModel = PLAIN_SHADING
    if config.materials.learn:  # it holds normals and depths together itself
        inner = make_deferred_shading(config, extent_world)
    elif config.loss.depth_normal > 0:
        inner = DepthNormalShading(config.loss.depth_normal)
    if config.background == "learnt":
        inner = LearnedBackground(
            config.background_height,
            rate=config.lr.background,
            decay=config.lr.decay,
            smoothness_weight=BACKGROUND_SMOOTHNESS,
            inner=inner,
        )
    if config.exposure is True:
        return ExposureModel(views, rate=config.lr.exposure, decay=config.lr.decay, inner=inner)
    return inner


def make_deferred_shading(config: TrainConfig, extent_world: float) -> DeferredShading:
    """The model of materials, with an environment of which nothing is known yet."""
    return DeferredShading(
        config.materials,
        extent_world=extent_world,
        one_sided=config.trace.flip_normal_cos > 0,
    )


def find_exposures(shading: ShadingModel) -> ExposureModel | None:
    """The exposures that a shading model learns."""
    return shading if isinstance(shading, ExposureModel) else None


def shading_for_view(shading: ShadingModel, view: int) -> ShadingModel:
    """What develops a view of the dataset, trained on or held out, as exposed as that is known to be."""
    exposures = find_exposures(shading)
    return shading if exposures is None else exposures.for_view(view)


def find_background(shading: ShadingModel) -> LearnedBackground | None:
    """The learnt background that a shading model is, or has inside."""
    if isinstance(shading, ExposureModel):
        return find_background(shading.inner)
    return shading if isinstance(shading, LearnedBackground) else None


def find_deferred(shading: ShadingModel) -> DeferredShading | None:
    """The model of materials that a shading model is, or has inside."""
    if isinstance(shading, ExposureModel):
        return find_deferred(shading.inner)
    return shading if isinstance(shading, DeferredShading) else None
