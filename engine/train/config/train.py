"""All settings of one training.

Lengths marked "of the extent" are relative to the scene's robust extent (from the cameras), so that one
preset serves a coin and a street.
"""

from typing import Annotated, ClassVar

from pydantic import Field, model_validator

from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.fields import ADVANCED, EXPERIMENTAL, Unit
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.trace.protocol import TraceSettings
from octasplat.engine.train.config.densify import McmcConfig, RedisplatsConfig
from octasplat.engine.train.config.gaussians import GaussianSettings
from octasplat.engine.train.config.learning_rates import LearningRates
from octasplat.engine.train.config.loss import LossWeights
from octasplat.engine.train.config.photographs import PhotographSettings
from octasplat.engine.train.config.rays import RaySettings


class TrainConfig(PhotographSettings, GaussianSettings, RaySettings):
    """One training run, fully resolved; the defaults are the ``standard`` preset.

    ``paper`` stands for "REdiSplats: Ray Tracing for Editable Gaussian Splatting"
    (https://arxiv.org/abs/2503.12284), where one of several ways is named after it.
    """

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.TRAIN
    later_settings: ClassVar[frozenset[str]] = frozenset({"opacity_decay"})

    weight_averaging_start: Annotated[float, Unit("share of iterations"), ADVANCED] = Field(
        0.85,
        ge=0,
        le=1,
        description="Share of the iterations after which states are averaged; the mean is exported. 1 "
        "exports the last state.",
    )
    min_blend_weight: Annotated[float, Unit("sum of weights"), ADVANCED] = Field(
        0.03,
        ge=0,
        description="Gaussians whose weights on the rays of an iteration add up to less keep still in it, "
        "which saves time. 0 moves all.",
    )
    shared_sort_until: Annotated[float, Unit("share of iterations"), ADVANCED] = Field(
        0.8,
        ge=0,
        le=1,
        description="Share of the training in which the rays of a window composite in one order, which is "
        "several times as fast and a little wrong; not with materials, depth maps or loss.depth_normal. 0 "
        "gives each ray its own order throughout.",
    )
    lr: LearningRates = Field(LearningRates(), description="Sizes of the steps of the optimiser.")
    loss: LossWeights = Field(LossWeights(), description="Weights of the terms of the loss.")
    trace: TraceSettings = Field(TraceSettings(), description="How rays are traced.")
    materials: MaterialSettings = Field(
        MaterialSettings(), description="How materials and light are learnt, where they are."
    )
    near: Annotated[float, Unit("extent"), ADVANCED] = Field(
        0.01,
        ge=0,
        description="Nearest distance at which a Gaussian is seen, of the extent. Lower it for cameras that "
        "come very close to something.",
    )
    camera_clearance: Annotated[float, Unit("share"), ADVANCED] = Field(
        0.3,
        ge=0,
        lt=1,
        description="Nothing stays nearer to the camera of a training view than this share of the distance "
        "at which the sparse points around it begin, in the end half as far again; 0 lets everything stay.",
    )
    min_scale_px: Annotated[float, Unit("px"), EXPERIMENTAL] = Field(
        0.0,
        ge=0,
        description="Least standard deviation, in pixels of the nearest training camera, against detail that "
        "shimmers from farther away; 0 sets none.",
    )
    densify: McmcConfig | RedisplatsConfig = Field(
        McmcConfig(), discriminator="kind", description="How Gaussians come and go."
    )
    rebuild_every: Annotated[int, Unit("iterations"), ADVANCED] = Field(
        25,
        ge=1,
        description="Iterations between rebuilds of the hierarchy of up to 500,000 Gaussians. More save time "
        "where Gaussians move little.",
    )
    box_padding: Annotated[float, Unit("share of its size"), ADVANCED] = Field(
        0.1,
        ge=0,
        description="Fraction of its size by which the box of a Gaussian is enlarged for single rays, so "
        "that it may move before the next rebuild. Raise it together with rebuild_every.",
    )
    checkpoint_every: Annotated[int, Unit("iterations"), ADVANCED] = Field(
        500,
        ge=1,
        description="Iterations between checkpoints, rounded up to a multiple of rebuild_every. Lower it "
        "where runs are often interrupted.",
    )
    probe_rays: Annotated[int, Unit("rays"), ADVANCED] = Field(
        16_384, ge=256, description="Fixed training rays that choose the best checkpoint."
    )
    best_checkpoint_margin_db: Annotated[float, Unit("dB"), ADVANCED] = Field(
        3.0,
        gt=0,
        description="The best state is exported where the last one's probe is so much worse. Lower it where "
        "trainings get worse towards their end.",
    )
    seed: Annotated[int, ADVANCED] = Field(
        0, ge=0, description="Seed of everything random; the same seed gives the same bytes."
    )

    @model_validator(mode="after")
    def _fits_together(self) -> "TrainConfig":
        if self.loss.depth_normal > 0 and not self.materials.learn and self.ray_patch_rays == 1:
            raise ValueError(
                "loss.depth_normal compares neighbouring rays of windows: set ray_patch_rays to 64"
            )
        if self.loss.edges and not self.materials.learn:
            raise ValueError("loss.edges is for trainings with materials: set it to 0")
        if self.trace.sort != "ray":
            raise ValueError(
                "trace.sort is the training's own; shared_sort_until says for which share it is packet"
            )
        if self.background == "learnt" and self.materials.learn:
            raise ValueError(
                "background=learnt is for scenes without materials, which learn the light around them: leave "
                "one of the two out"
            )
        if self.refine_poses and self.materials.learn:
            raise ValueError(
                "refine_poses aligns photographs by what keeps its place, which reflections do not: leave it "
                "or the materials out"
            )
        return self
