"""How Gaussians are added, moved and removed while training."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.base import Settings
from octasplat.engine.settings.fields import ADVANCED, EXPERIMENTAL, Unit


class McmcConfig(Settings):
    """Relocation of the dead and growth up to a cap, see :mod:`octasplat.engine.train.densify.mcmc`."""

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.DENSIFY

    kind: Annotated[Literal["mcmc"], ADVANCED] = Field(
        "mcmc",
        description="Strategy that adds, moves and removes Gaussians: mcmc relocates and grows up to the "
        "cap, redisplats clones and splits. Another kind begins from its own defaults.",
    )
    start: Annotated[int, Unit("iterations"), ADVANCED] = Field(
        100, ge=0, description="First iteration at which Gaussians are relocated and added."
    )
    stop_fraction: Annotated[float, Unit("share of iterations"), ADVANCED] = Field(
        0.85,
        ge=0,
        le=1,
        description="Share of the iterations after which nothing is added or moved any more, so that what is "
        "there can settle.",
    )
    interval: Annotated[int, Unit("iterations"), ADVANCED] = Field(
        100, ge=1, description="Iterations between two relocations. Lower it with growth in short trainings."
    )
    growth: Annotated[float, Unit("share"), ADVANCED] = Field(
        0.2,
        ge=0,
        description="Fraction of the Gaussians that is added at each interval until max_gaussians. 0 keeps "
        "the number with which the training begins.",
    )
    dead_opacity: Annotated[float, Unit("opacity"), ADVANCED] = Field(
        0.012,
        gt=0,
        lt=1,
        description="Gaussians of at most this opacity are dead and are moved. Raise it to clear away "
        "fainter haze.",
    )
    copies: Annotated[Literal["opacity", "area"], ADVANCED] = Field(
        "opacity",
        description="What a Gaussian and its copies share; area suits opaque surfaces, as with materials.",
    )
    error_power: Annotated[float, Unit("exponent"), EXPERIMENTAL] = Field(
        0.0,
        ge=0,
        description="Exponent of the error by which growth chooses its places: 0 chooses by opacity alone, 1 "
        "by the error seen through a Gaussian.",
    )
    relocate_low_weight_below: Annotated[float, Unit("share of the mean"), ADVANCED] = Field(
        0.05,
        ge=0,
        description="Where there are as many as there may be, those whose weight on the rays is below this "
        "share of the mean are moved, too, all of them to where the error is seen; 0 moves the dead alone.",
    )
    relocate_low_weight_fraction: Annotated[float, Unit("share"), ADVANCED] = Field(
        0.05,
        ge=0,
        le=1,
        description="Most of all Gaussians that are moved for a low weight at a time.",
    )
    relocate_low_weight_rounds: Annotated[int, Unit("rounds"), ADVANCED] = Field(
        16,
        ge=1,
        description="About how often in a training those of low weight are moved; rounded to whole "
        "intervals.",
    )


class RedisplatsConfig(Settings):
    """Clone and split by the Adam step of the mean, prune.

    See :mod:`octasplat.engine.train.densify.redisplats`.
    """

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.DENSIFY

    kind: Annotated[Literal["redisplats"], ADVANCED] = Field(
        "redisplats",
        description="Strategy that adds, moves and removes Gaussians: mcmc relocates and grows up to the "
        "cap, redisplats clones and splits. Another kind begins from its own defaults.",
    )
    start: Annotated[int, Unit("iterations"), ADVANCED] = Field(
        400, ge=0, description="First iteration at which Gaussians are cloned, split and pruned."
    )
    stop_fraction: Annotated[float, Unit("share of iterations"), ADVANCED] = Field(
        0.5,
        ge=0,
        le=1,
        description="Share of the iterations after which nothing is cloned, split or pruned any more.",
    )
    interval: Annotated[int, Unit("iterations"), ADVANCED] = Field(
        100, ge=1, description="Iterations between two times of cloning, splitting and pruning."
    )
    step_threshold: Annotated[float, Unit("extent"), ADVANCED] = Field(
        1.0e-4,
        gt=0,
        description="Norm of one Adam step of the mean from which on a Gaussian is duplicated, of the "
        "extent. Lower it for more Gaussians.",
    )
    split_scale: Annotated[float, Unit("extent"), ADVANCED] = Field(
        0.005,
        gt=0,
        description="Norm of the scales above which to split instead of cloning, of the extent.",
    )
    prune_opacity: Annotated[float, Unit("opacity"), ADVANCED] = Field(
        0.039, gt=0, lt=1, description="Gaussians below this opacity are removed. Lower it to keep haze."
    )
    min_scale: Annotated[float, Unit("extent"), ADVANCED] = Field(
        1e-5, ge=0, description="Smallest norm of the scales that is kept, of the extent."
    )
    max_scale: Annotated[float, Unit("extent"), ADVANCED] = Field(
        0.5,
        gt=0,
        description="Largest norm of the scales that is kept, of the extent. Raise it for skies made of few "
        "huge Gaussians.",
    )
    split_shrink: Annotated[float, Unit("factor"), ADVANCED] = Field(
        1.6, gt=1, description="Factor by which the scales of both halves of a split one are divided."
    )
