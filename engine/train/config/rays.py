"""How long is trained, and with which rays."""

import math
from typing import Annotated

from pydantic import Field, field_validator

from octasplat.engine.settings.base import Settings
from octasplat.engine.settings.fields import ADVANCED, BASIC, Unit


class RaySettings(Settings):
    """Number of iterations, and the rays of each."""

    iterations: Annotated[int, Unit("iterations"), BASIC] = Field(
        0,
        ge=0,
        description="Iterations of the training; more take longer and get sharper. 0: rays_per_pixel rays "
        "for each pixel of the training views, in thousands of iterations.",
    )
    early_stopping_db: Annotated[float, Unit("dB"), ADVANCED] = Field(
        0.05,
        ge=0,
        description="End sooner where the training rays gain less than so many dB in a fifth of the "
        "iterations; 0 never does.",
    )
    rays_per_pixel: Annotated[int, Unit("rays per pixel"), ADVANCED] = Field(
        7,
        ge=1,
        description="Rays for each pixel of the training views, where iterations is 0: 7,000 to 23,000 "
        "iterations for 7, with depth maps or loss.depth_normal 5,000 to 10,000. Raise it for the last few "
        "tenths of a dB, as the preset high does.",
    )
    rays_per_batch: Annotated[int, Unit("rays"), ADVANCED] = Field(
        16_384,
        ge=64,
        description="Rays of one iteration. More make smoother gradients and take as much longer.",
    )
    ray_patch_rays: Annotated[int, Unit("rays"), ADVANCED] = Field(
        64,
        ge=1,
        description="Rays of one window of neighbouring pixels, a square number; 1 scatters them, which is "
        "slower.",
    )
    ray_patch_side: Annotated[int, Unit("px"), ADVANCED] = Field(
        0,
        ge=0,
        description="Pixels that a window spans; 0: as many as six Gaussians stand for, at most a fifteenth "
        "of the views' longest side, which it is where each ray has an order of its own.",
    )
    ssim_patch_fraction: Annotated[float, Unit("share of rays"), ADVANCED] = Field(
        0.25,
        ge=0,
        le=1,
        description="Share of the rays that comes in whole patches, where loss.ssim is more than 0.",
    )
    ssim_patch_side: Annotated[int, Unit("px"), ADVANCED] = Field(
        32,
        ge=16,
        description="Side of a patch for loss.ssim, in pixels. Touch it only to repeat published recipes.",
    )

    @field_validator("ray_patch_rays")
    @classmethod
    def _is_a_square(cls, value: int) -> int:
        if math.isqrt(value) ** 2 != value:
            raise ValueError("must be a square number, since a window has as many rows as columns")
        return value
