"""Sizes of the steps of the optimiser."""

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from octasplat.engine.gaussians.materials import ALBEDO, METALLIC, ROUGHNESS
from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.base import Settings
from octasplat.engine.settings.fields import ADVANCED, EXPERIMENTAL, Unit


class LearningRates(Settings):
    """Sizes of the Adam steps, which fall exponentially over the run.

    The mean's falls to ``mean_final``; all others fall to the fraction ``decay``.
    """

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.LEARNING_RATES

    mean: Annotated[float, Unit("mean_unit"), ADVANCED] = Field(
        0.14,
        gt=0,
        description="First step of the means, in the unit that mean_unit says. Lower it where training loses "
        "detail that it had, raise it where Gaussians begin far from the surface.",
    )
    mean_final: Annotated[float, Unit("mean_unit"), ADVANCED] = Field(
        1e-2,
        gt=0,
        description="Last step of the means, in the same unit. Lower it for sharper detail in long "
        "trainings.",
    )
    mean_unit: Annotated[Literal["size", "extent"], ADVANCED] = Field(
        "size",
        description="Unit of mean and mean_final: the Gaussian's own size, or the scene's extent as in 3DGS. "
        "Change it only together with both.",
    )
    axes: Annotated[Literal["own", "world"], EXPERIMENTAL] = Field(
        "own",
        description="Axes along and around which means and rotations take their steps: the Gaussian's own, "
        "or the world's as in the published methods.",
    )
    quat: Annotated[float, Unit("Adam step"), ADVANCED] = Field(
        0.015,
        ge=0,
        description="First step of the rotation quaternions. Lower it where normals must settle, as with "
        "materials; 0 keeps rotations.",
    )
    log_scale: Annotated[float, Unit("Adam step"), ADVANCED] = Field(
        0.04,
        ge=0,
        description="First step of the logarithms of the two standard deviations; 0 keeps sizes. Lower it "
        "where Gaussians grow into needles.",
    )
    opacity: Annotated[float, Unit("Adam step"), ADVANCED] = Field(
        0.1,
        ge=0,
        description="First step of the opacity logits; 0 keeps opacities. Lower it where surfaces become "
        "transparent early.",
    )
    color: Annotated[float, Unit("display color"), ADVANCED] = Field(
        1e-2,
        ge=0,
        description="First step of the display color; the constant harmonic gets it over C0. Raise it in "
        "very short trainings.",
    )
    sh_rest_ratio: Annotated[float, Unit("share of color"), ADVANCED] = Field(
        0.1,
        ge=0,
        description="Step of the higher harmonics, of the constant one's. Lower it where colors flicker "
        "between views.",
    )
    exposure: Annotated[float, Unit("log gain"), ADVANCED] = Field(
        2e-3,
        ge=0,
        description="First step of the views' log gains and offsets, where exposure is learnt. Raise it for "
        "short trainings of photographs of very different brightness.",
    )
    background: Annotated[float, Unit("display color"), ADVANCED] = Field(
        0.01, ge=0, description="First step of the display colors of a learnt background."
    )
    albedo: Annotated[float, Unit("Adam step"), ADVANCED] = Field(
        0.03, ge=0, description="First step of the albedo logit, where materials are learnt; 0 keeps it."
    )
    metallic: Annotated[float, Unit("Adam step"), ADVANCED] = Field(
        0.03, ge=0, description="First step of the metallic logit, where materials are learnt; 0 keeps it."
    )
    roughness: Annotated[float, Unit("Adam step"), ADVANCED] = Field(
        0.03, ge=0, description="First step of the roughness logit, where materials are learnt; 0 keeps it."
    )
    decay: Annotated[float, Unit("share"), ADVANCED] = Field(
        0.3,
        gt=0,
        le=1,
        description="Fraction of their first size to which all steps but the mean's fall until the end; 1 "
        "keeps them. Lower it where the last iterations still fluctuate.",
    )
    scale_after: Annotated[int, Unit("iterations"), ADVANCED] = Field(
        7000,
        ge=0,
        description="In trainings of more iterations mean and quat are smaller, by the root of how many "
        "times as many there are; 0: never. Touch it only when changing mean or quat for long trainings.",
    )

    def scaled_for(self, iterations: int) -> "LearningRates":
        """Return the rates for a training of so many iterations: with more time, small steps go farther."""
        if self.scale_after == 0 or iterations <= self.scale_after:
            return self
        share = math.sqrt(self.scale_after / iterations)
        # never below the last step, to which it falls
        mean = min(self.mean, max(share * self.mean, self.mean_final))
        return self.model_copy(update={"mean": mean, "quat": share * self.quat})

    def channel_rate(self, name: str) -> float:
        """Return the rate of a named channel; 0 where it is not trained."""
        return {ALBEDO: self.albedo, METALLIC: self.metallic, ROUGHNESS: self.roughness}.get(name, 0.0)
