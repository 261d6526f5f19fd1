"""Every knob of training with its default, and the presets.

Lengths marked "of the extent" are relative to the scene's robust extent (from the cameras), so that one
preset serves a coin and a street.
"""

import math
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from octasplat.engine.errors import ConfigError
from octasplat.engine.gaussians.materials import ALBEDO, METALLIC, ROUGHNESS
from octasplat.engine.gaussians.octagon import CHI2_3_99
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.trace.protocol import TraceSettings
from octasplat.engine.train.preset_names import PRESETS

MOST_PLANNED_ITERATIONS = 70_000
"""Where a time decides their number, see :mod:`octasplat.engine.train.within`."""

LEAST_THOUSANDS = 5
"""Of iterations, where the photographs decide their number."""
OWN_ORDER = 3 / 7
"""Share of the rays that a training has time for where each ray has an order of its own."""
TURNED_BEYOND = 0.5
"""Cosine beyond which normals that point away are turned, where materials are learnt."""
FOR_SURFACE = 0.05
"""Weight of ``loss.depth_normal`` for scenes of which a surface is to be made, see ``docs/surface.md``."""


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class LearningRates(_Frozen):
    """Sizes of the Adam steps, falling exponentially over the run.

    The mean's falls to ``mean_final``; all others fall to the fraction ``decay``. In long trainings means and
    turns begin with smaller steps.
    """

    mean: float = Field(0.14, gt=0)
    mean_final: float = Field(1e-2, gt=0)
    mean_of: Literal["size", "extent"] = Field(
        "size", description="unit of the two: the Gaussian's own size, or the scene's extent"
    )
    axes: Literal["own", "world"] = Field(
        "own", description="along and around which means and rotations take their steps"
    )
    quat: float = Field(0.015, ge=0)
    log_scale: float = Field(0.04, ge=0)
    opacity: float = Field(0.1, ge=0)
    colour: float = Field(1e-2, ge=0, description="of the display colour; harmonics get it over C0")
    sh_rest_ratio: float = Field(0.1, ge=0, description="of the constant harmonic's step")
    exposure: float = Field(2e-3, ge=0, description="of the views' log gains and offsets, where learnt")
    background: float = Field(0.01, ge=0, description="of a learnt background's display colours")
    albedo: float = Field(0.03, ge=0, description="of the logit, as for the two below")
    metallic: float = Field(0.03, ge=0)
    roughness: float = Field(0.03, ge=0)
    decay: float = Field(0.3, gt=0, le=1)
    calm_after: int = Field(
        7000,
        ge=0,
        description="in trainings of more iterations mean and quat are smaller, by the root of how many "
        "times as many there are; 0: never",
    )

    def calmed(self, iterations: int) -> "LearningRates":
        """The rates for a training of so many iterations: where there is time, small steps go farther."""
        if self.calm_after == 0 or iterations <= self.calm_after:
            return self
        share = math.sqrt(self.calm_after / iterations)
        mean = min(self.mean, max(share * self.mean, self.mean_final))
        return self.model_copy(update={"mean": mean, "quat": share * self.quat})

    def of_channel(self, name: str) -> float:
        """The rate of a named channel; 0 where it is not trained."""
        return {ALBEDO: self.albedo, METALLIC: self.metallic, ROUGHNESS: self.roughness}.get(name, 0.0)


class LossWeights(_Frozen):
    """Weights of the loss terms; means over the batch's valid rays and channels.

    The families of the field: 0.8 L1 + 0.2 (1 - SSIM), as in "3D Gaussian Ray Tracing: Fast Tracing of
    Particle Scenes" (https://arxiv.org/abs/2407.07090), is l1 = 0.8, ssim = 0.2; the authors of REdiSplats
    (https://arxiv.org/abs/2503.12284) use 0.8 MSE + 0.2 (1 - SSIM)/2: l2 = 0.8, ssim = 0.1.
    """

    l1: float = Field(0.8, ge=0)
    l2: float = Field(1.0, ge=0)
    ssim: float = Field(0.0, ge=0)
    opacity: float = Field(0.0, ge=0, description="mean opacity of the Gaussians that were hit")
    scale: float = Field(0.0, ge=0, description="mean in-plane scale of those, of the extent")
    blocked: float = Field(0.0, ge=0, description="what hides the sparse points from views that show them")
    depth_normal: float = Field(
        0.0, ge=0, description="one minus the cosine between normals and what depths span; not with materials"
    )


class McmcConfig(_Frozen):
    """Relocation of the dead and growth up to a cap, see :mod:`octasplat.engine.train.densify.mcmc`."""

    kind: Literal["mcmc"] = "mcmc"
    start: int = Field(100, ge=0)
    stop_fraction: float = Field(0.85, ge=0, le=1, description="of all iterations")
    interval: int = Field(100, ge=1)
    growth: float = Field(0.2, ge=0, description="fraction added at each interval")
    dead_opacity: float = Field(0.012, gt=0, lt=1)
    copies: Literal["opacity", "area"] = Field(
        "opacity", description="what a Gaussian and its copies share: area suits opaque surfaces"
    )
    error_power: float = Field(
        0.0, ge=0, description="0 samples by opacity alone, 1 by the error seen through it"
    )
    idle_weight: float = Field(
        0.05,
        ge=0,
        description="where there are as many as there may be, those whose weight on the rays is below this "
        "share of the mean are moved, too, all of them to where the error is seen; 0 moves the dead alone",
    )
    idle_share: float = Field(0.05, ge=0, le=1, description="most of all that are moved for that at a time")
    idle_rounds: int = Field(16, ge=1, description="about how often in a training, in whole intervals")


class PaperConfig(_Frozen):
    """Clone and split by the Adam step of the mean, prune.

    See :mod:`octasplat.engine.train.densify.paper`.
    """

    kind: Literal["paper"] = "paper"
    start: int = Field(400, ge=0)
    stop_fraction: float = Field(0.5, ge=0, le=1)
    interval: int = Field(100, ge=1)
    step_threshold: float = Field(
        1.0e-4, gt=0, description="norm of one Adam step of the mean, of the extent"
    )
    split_scale: float = Field(
        0.005, gt=0, description="norm of the scales above which to split, of the extent"
    )
    prune_opacity: float = Field(0.039, gt=0, lt=1)
    min_scale: float = Field(1e-5, ge=0, description="smallest scale norm kept, of the extent")
    max_scale: float = Field(0.5, gt=0, description="largest scale norm kept, of the extent")
    split_shrink: float = Field(1.6, gt=1)


class TrainConfig(_Frozen):
    """One training run, fully resolved; the defaults are the ``standard`` preset.

    ``paper`` stands for "REdiSplats: Ray Tracing for Editable Gaussian Splatting"
    (https://arxiv.org/abs/2503.12284), where one of several ways is named after it.
    """

    iterations: int = Field(
        0,
        ge=0,
        description="0: rays_a_pixel rays for each pixel of the training views, in thousands",
    )
    stop_early: float = Field(
        0.05,
        ge=0,
        description="end sooner where the training rays gain less than so many dB in a fifth of the "
        "iterations; 0 never does",
    )
    rays_a_pixel: int = Field(7, ge=1, description="where iterations is 0; 7,000 to 23,000 iterations for 7")
    rays: int = Field(16_384, ge=64, description="rays of one iteration")
    window_rays: int = Field(64, ge=1, description="rays of one window, a square number; 1 scatters them")
    window_side: int = Field(
        0,
        ge=0,
        description="pixels that a window spans; 0: as many as six Gaussians stand for, at most a fifteenth "
        "of the views' longest side, which it is where each ray has an order of its own",
    )
    patch_fraction: float = Field(
        0.25, ge=0, le=1, description="share of the rays that comes in patches for SSIM"
    )
    patch_side: int = Field(32, ge=16)
    fit_iterations: int = Field(100, ge=0, description="fitting before anything is added")
    sh_degree: int = Field(3, ge=0, le=3)
    sh_every: int = Field(100, ge=1, description="iterations between raising the degree")
    max_gaussians: int = Field(
        0,
        ge=0,
        description="0: one for each 30 pixels of the training views or, of up to 10,000, for each 10",
    )
    pixels_a_gaussian: int = Field(30, ge=10, description="where max_gaussians is 0")
    max_gaussians_auto: int = Field(400_000, ge=1, description="the most that 0 comes to in max_gaussians")
    initial_points: int = Field(
        600_000,
        ge=1,
        description="most points to begin from; Gaussians that are added later overlap more with those that "
        "are there",
    )
    plane_points: int = Field(8, ge=3, description="points around one whose plane gives its first normal")
    lift_pixels: bool = Field(
        True, description="where the sparse model has fewer points, lift pixels of the photographs"
    )
    lift_unseen: bool = Field(
        False,
        description="lift pixels that no neighbouring photographs show, too: where photographs are few, "
        "detail instead of smears, not always at the right place",
    )
    initial_opacity: float = Field(0.5, gt=0, lt=1)
    background: Literal["auto", "black", "white", "random", "learnt"] = Field(
        "auto",
        description="behind everything; auto is random for photographs with alpha, else black; learnt is a "
        "map of what is infinitely far away, such as the sky",
    )
    background_height: int = Field(
        256, ge=16, le=2048, multiple_of=2, description="texels of a learnt background from up to down"
    )
    background_even: float = Field(
        0.1, ge=0, description="weight of the differences between its neighbouring texels"
    )
    exposure: bool | Literal["auto"] = Field(
        "auto",
        description="learn a gain and an offset for each channel of each training view; auto does so where "
        "the photographs show that the exposure changes",
    )
    leave_out_misfits: bool = Field(
        False, description="train without the views that do not fit the others, as it becomes clear which"
    )
    place_misfits: bool = Field(
        True,
        description="look for photographs of a given model that stand in the wrong place, and place them "
        "anew before the training; not before one of less than 1,000 iterations or 10 minutes",
    )
    free_lenses: bool = Field(
        True,
        description="let each photograph of a model have a principal point of its own, where the sparse "
        "points show that the lens moved, as stabilised ones do; not before a training of less than 1,000 "
        "iterations or 10 minutes",
    )
    misfits_after: float = Field(
        0.3, ge=0, le=1, description="share of the iterations after which checkpoints look for them"
    )
    refine_poses: bool = Field(
        False, description="learn a small correction of the pose of each training view; not with materials"
    )
    sight_line_share: float = Field(
        0.02, gt=0, le=1, description="lines of sight of sparse points beside each batch, of its rays"
    )
    sight_line_margin: float = Field(
        0.003, ge=0, lt=0.5, description="least distance before its point at which one ends, of its length"
    )
    average_after: float = Field(
        0.85,
        ge=0,
        le=1,
        description="share of the iterations after which states are averaged; the mean is exported",
    )
    least_weight: float = Field(
        0.03,
        ge=0,
        description="Gaussians whose weights on the rays of an iteration add up to less keep still in it",
    )
    one_order: float = Field(
        0.8,
        ge=0,
        le=1,
        description="share of the training in which the rays of a window composite in one order, which is "
        "several times as fast and a little wrong; not with materials or loss.depth_normal",
    )
    rates: LearningRates = LearningRates()
    loss: LossWeights = LossWeights()
    trace: TraceSettings = TraceSettings()
    materials: MaterialSettings = MaterialSettings()
    near: float = Field(0.01, ge=0, description="nearest distance at which a Gaussian is seen, of the extent")
    near_share: float = Field(
        0.3,
        ge=0,
        lt=1,
        description="nothing stays nearer to the camera of a training view than this share of the distance "
        "at which the sparse points around it begin, in the end half as far again; 0 lets everything stay",
    )
    min_scale_px: float = Field(
        0.0, ge=0, description="least standard deviation, in pixels of the nearest training camera"
    )
    densify: McmcConfig | PaperConfig = Field(McmcConfig(), discriminator="kind")
    rebuild_every: int = Field(
        25, ge=1, description="iterations between rebuilds of the hierarchy of up to 500,000 Gaussians"
    )
    box_padding: float = Field(0.1, ge=0)
    checkpoint_every: int = Field(500, ge=1, description="rounded up to a multiple of rebuild_every")
    probe_rays: int = Field(16_384, ge=256, description="fixed training rays that choose the best checkpoint")
    step_back_db: float = Field(
        3.0, gt=0, description="the best state is exported where the last one's probe is so much worse"
    )
    seed: int = Field(0, ge=0)

    @field_validator("window_rays")
    @classmethod
    def _is_a_square(cls, value: int) -> int:
        if math.isqrt(value) ** 2 != value:
            raise ValueError("must be a square number, since a window has as many rows as columns")
        return value

    @model_validator(mode="after")
    def _fits_together(self) -> "TrainConfig":
        if self.loss.depth_normal > 0 and not self.materials.learn and self.window_rays == 1:
            raise ValueError("loss.depth_normal compares neighbouring rays of windows: set window_rays to 64")
        if self.trace.order != "ray":
            raise ValueError("trace.order is the training's own; one_order says for which share it is packet")
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


def iteration_count(config: TrainConfig, training_pixels: int, shown: float = 1.0) -> int:
    """``config.iterations``, or where that is 0 so many rays for each pixel, in whole thousands.

    Large scenes learn as long as there is something to see; small ones are done after 7,000 with 7 rays a
    pixel. Rays that have an order of their own take longer, so that there are fewer of them. Where only a
    share of the pixels shows anything (see :mod:`octasplat.engine.train.shown`), the rays of the others teach
    little and cost little, and it takes as many more; not with materials.
    """
    each = config.rays_a_pixel
    if in_one_order(config):
        least = max(LEAST_THOUSANDS, each)
    else:
        if not config.materials.learn:  # which have a number of their own
            each = max(1, round(OWN_ORDER * each))
        least = LEAST_THOUSANDS * max(1, each // 3)
    wanted = max(round(each * training_pixels / config.rays / 1000), least)
    if not config.materials.learn:
        wanted = round(wanted / shown)
    return config.iterations or min(wanted, 10 * each // 3) * 1000


def most_gaussians(config: TrainConfig, training_pixels: int, shown: float = 1.0) -> int:
    """``config.max_gaussians``, or where that is 0 what so many pixels of training views can hold down.

    Of those only the share counts that shows anything. More than one for each 10 pixels learn the noise of
    the training views instead of the scene.
    """
    if config.max_gaussians:
        return config.max_gaussians
    training_pixels = round(training_pixels * shown)
    wanted = max(training_pixels // config.pixels_a_gaussian, min(training_pixels // 10, 10_000), 1)
    return min(wanted, config.max_gaussians_auto)


def in_one_order(config: TrainConfig) -> bool:
    """Whether the rays of a window composite in one order for a part of the training.

    Gradients by depths and normals, and a second phase, want each ray's own.
    """
    by_geometry = config.materials.learn or config.loss.depth_normal > 0
    return config.one_order > 0 and not by_geometry and config.trace.second_phase_min is None


def window_side_px(config: TrainConfig, longest_side_px: int, pixels_a_gaussian: float) -> int:
    """``config.window_side``, or where that is 0 what suits the Gaussians or the views.

    A window is to cover a small angle, so that its rays meet the same Gaussians: what these cost once for all
    rays is most of what rays in one order cost. But rays that are too close learn the same.
    """
    if config.window_side:
        return config.window_side
    widest = max(1, round(longest_side_px / 15))
    if not in_one_order(config):
        return widest
    return min(widest, max(1, round(math.sqrt(6 * pixels_a_gaussian))))


def rebuild_interval(config: TrainConfig, gaussians: int) -> int:
    """Iterations between rebuilds of the hierarchy: ``rebuild_every``, as much again for each half million.

    A rebuild takes time for every Gaussian, an iteration only for those that its rays meet.
    """
    return config.rebuild_every * (1 + gaussians // 500_000)


def with_materials(config: TrainConfig) -> TrainConfig:
    """A configuration for shiny things: materials are learnt, and geometry keeps still enough for mirrors.

    Reflections ask for normals to within a degree, so steps are small. Points lifted from photographs that
    show reflections lie behind the surface, so there are none.
    """
    rates = {
        "quat": 1e-3,
        "mean": 0.016,
        "mean_final": 1e-3,
        "log_scale": 0.02,
        "opacity": 0.1,
        "sh_rest_ratio": 0.05,
        "calm_after": 0,
    }
    return config.model_copy(
        update={
            # Rays may begin so near to a surface as they pass it, which normals with a side allow.
            "materials": config.materials.model_copy(
                update={"learn": True, "start": 1e-3, "leaves": 1e-2, "parted": 8.0}
            ),
            "rates": config.rates.model_copy(update=rates),
            # Gaps under things that stand on a mirror would be filled with what looks like the reflection.
            "loss": config.loss.model_copy(update={"blocked": 0.05}),
            "lift_pixels": False,
            "plane_points": 10,
            "sh_degree": min(config.sh_degree, 1),
            "sh_every": 400,
            "rays": 8192,
            "iterations": config.iterations * 14 // 25,  # which take longer by ray, and longer with light
            "rays_a_pixel": 8,
            "pixels_a_gaussian": 50,
            "step_back_db": 0.3,
            "average_after": 0.8,
            "least_weight": 0.0,
            "near_share": 0.0,
            "one_order": 0.0,
            "stop_early": 0.0,
            "densify": McmcConfig(copies="area", stop_fraction=0.4, idle_weight=0.0),
            "initial_opacity": 0.8,
            "trace": config.trace.model_copy(update={"turned_beyond": TURNED_BEYOND}),
            "max_gaussians_auto": min(config.max_gaussians_auto * 4 // 5, 80_000),
        }
    )


def preset(name: str) -> TrainConfig:
    """The named preset.

    Raises:
        ConfigError: there is no such preset.
    """
    if name == "fast":
        return TrainConfig(iterations=2500, max_gaussians_auto=50_000)
    if name == "standard":
        return TrainConfig()
    if name == "high":
        return TrainConfig(rays_a_pixel=21, max_gaussians_auto=600_000)
    if name == "paper":
        return TrainConfig(
            iterations=10_000,
            sh_degree=0,
            rays=8192,
            least_weight=0.0,
            near_share=0.0,
            one_order=0.0,
            stop_early=0.0,
            place_misfits=False,
            free_lenses=False,
            window_rays=1,
            pixels_a_gaussian=50,
            max_gaussians_auto=350_000,
            initial_points=30_000,
            lift_pixels=False,
            initial_opacity=0.1,
            rates=LearningRates(
                mean=5e-4,
                mean_final=3e-6,
                mean_of="extent",
                axes="world",
                quat=0.01,
                log_scale=5e-3,
                opacity=0.05,
                colour=1.4e-3,
                decay=0.1,
                calm_after=0,
            ),
            loss=LossWeights(l1=0.0, l2=0.8, ssim=0.1),
            trace=TraceSettings(q=CHI2_3_99, transmittance_min=0.01, second_phase_min=0.01),
            densify=PaperConfig(),
        )
    listed = ", ".join(PRESETS)
    raise ConfigError(f"There is no preset called {name!r}; choose {listed}.")
