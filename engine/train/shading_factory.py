"""The shading model of a training, put together from what is to be learnt."""

from dataclasses import dataclass

from octasplat.engine.shading.background import LearnedBackground
from octasplat.engine.shading.deferred import DeferredShading
from octasplat.engine.shading.depth_normal_model import DepthNormalShading
from octasplat.engine.shading.exposure import ExposureModel
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.shading.recipes import material_shading
from octasplat.engine.shading.residual_colors import ResidualColors
from octasplat.engine.train.config import BACKGROUND_SMOOTHNESS, TrainConfig


@dataclass(frozen=True)
class ShadingOptions:
    """Materials that a shading model learns, and its learning rates.

    Attributes:
        materials: how materials and light are learnt; None where they are not.
        is_one_sided: whether normals point outwards, so that one side of each Gaussian is lit.
        depth_normal_weight: weight of the angle between normals and depths, without materials.
        background_height: texels from up to down of a learnt background; None where none is learnt.
        learns_exposure: whether each training view has an exposure of its own.
        background_lr: first step size of the background's texels.
        exposure_lr: first step size of the exposures.
        lr_decay: factor by which both have fallen at the end.
    """

    materials: MaterialSettings | None
    is_one_sided: bool
    depth_normal_weight: float
    background_height: int | None
    learns_exposure: bool
    background_lr: float
    exposure_lr: float
    lr_decay: float

    @classmethod
    def from_config(cls, config: TrainConfig) -> "ShadingOptions":
        """Return the options that a configuration asks for; an undecided exposure is not learnt."""
        return cls(
            materials=config.materials if config.materials.learn else None,
            is_one_sided=config.trace.flip_normal_cos > 0,
            depth_normal_weight=config.loss.depth_normal,
            background_height=config.background_height if config.background == "learnt" else None,
            learns_exposure=config.exposure is True,
            background_lr=config.lr.background,
            exposure_lr=config.lr.exposure,
            lr_decay=config.lr.decay,
        )


def make_shading(options: ShadingOptions, views: int, extent_world: float) -> ShadingModel:
    """Return the model, untrained, for a dataset of ``views`` views and that extent."""
    inner: ShadingModel = PLAIN_SHADING
    if options.materials is not None:  # it holds normals and depths together itself
        inner = material_shading(options.materials.recipe)(
            options.materials, extent_world=extent_world, one_sided=options.is_one_sided
        )
    elif options.depth_normal_weight > 0:
        inner = DepthNormalShading(options.depth_normal_weight)
    if options.background_height is not None:
        inner = LearnedBackground(
            options.background_height,
            rate=options.background_lr,
            decay=options.lr_decay,
            smoothness_weight=BACKGROUND_SMOOTHNESS,
            inner=inner,
        )
    if options.learns_exposure:
        return ExposureModel(views, rate=options.exposure_lr, decay=options.lr_decay, inner=inner)
    return inner


def find_exposures(shading: ShadingModel) -> ExposureModel | None:
    """Return the exposures that a shading model learns, or None."""
    return shading if isinstance(shading, ExposureModel) else None


def shading_for_view(shading: ShadingModel, view: int) -> ShadingModel:
    """Return the model with which to shade a view, trained or held out, at its exposure as far as known."""
    exposures = find_exposures(shading)
    return shading if exposures is None else exposures.for_view(view)


def find_background(shading: ShadingModel) -> LearnedBackground | None:
    """Return the learnt background that a shading model is or contains, or None."""
    if isinstance(shading, ExposureModel):
        return find_background(shading.inner)
    return shading if isinstance(shading, LearnedBackground) else None


def add_residual(shading: ShadingModel, residual: ResidualColors) -> ShadingModel:
    """Return the model with residual colors on its materials, below its exposures."""
    return shading.over(residual) if isinstance(shading, ExposureModel) else residual


def find_residual(shading: ShadingModel) -> ResidualColors | None:
    """Return the residual colors that a shading model is or contains, or None."""
    if isinstance(shading, ExposureModel):
        return find_residual(shading.inner)
    return shading if isinstance(shading, ResidualColors) else None


def find_deferred(shading: ShadingModel) -> DeferredShading | None:
    """Return the model of materials that a shading model is or contains, or None."""
    if isinstance(shading, ExposureModel | ResidualColors):
        return find_deferred(shading.inner)
    return shading if isinstance(shading, DeferredShading) else None
