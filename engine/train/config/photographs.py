"""What is believed of the photographs: background, exposure, poses."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from octasplat.engine.settings.base import FormerSetting, Settings
from octasplat.engine.settings.fields import ADVANCED, BASIC, Unit

BACKGROUND_SMOOTHNESS = 0.1
"""Weight of the differences between neighbouring texels of a learnt background."""
OUTLIER_VIEWS_FROM = 0.3
"""Share of the iterations after which checkpoints look for views that do not fit: earlier, all misfit."""
VISIBILITY_RAY_MARGIN = 0.003
"""Distance before its sparse point at which a line of sight ends, of its length."""
Background = Literal["auto", "black", "white", "random", "learnt"]


class PhotographSettings(Settings):
    """Background, exposure, and views that do not fit the others."""

    background: Annotated[Background, BASIC] = Field(
        "auto",
        description="What is behind everything: auto is random for photographs with alpha, else black; "
        "learnt is a map of what is infinitely far away, such as the sky, for captures outdoors.",
    )
    background_height: Annotated[int, Unit("texels"), ADVANCED] = Field(
        256,
        ge=16,
        le=2048,
        multiple_of=2,
        description="Texels of a learnt background from up to down; it has twice as many around. Raise it "
        "for detailed skylines.",
    )
    exposure: Annotated[bool | Literal["auto"], BASIC] = Field(
        "auto",
        description="Learn a gain and an offset for each channel of each training view; auto does so where "
        "the photographs show that the exposure changes.",
    )
    exclude_outlier_views: Annotated[bool, BASIC] = Field(
        False,
        description="Train without the views that do not fit the others, as it becomes clear which. Use it "
        "where a few photographs show something else or have wrong poses.",
    )
    repair_poses: Annotated[bool, ADVANCED] = Field(
        True,
        description="Look for photographs of a given model that stand in the wrong place, and place them "
        "anew before the training; not before one of less than 1,000 iterations or 10 minutes.",
    )
    per_view_principal_point: Annotated[bool, ADVANCED] = Field(
        True,
        description="Let each photograph of a model have a principal point of its own, where the sparse "
        "points show that the lens moved, as stabilised ones do; not before a training of less than 1,000 "
        "iterations or 10 minutes.",
    )
    refine_poses: Annotated[bool, BASIC] = Field(
        False,
        description="Learn a small correction of the pose of each training view; not with materials. Use it "
        "where poses come from a tracker rather than from COLMAP.",
    )
    visibility_ray_fraction: Annotated[float, Unit("share of rays"), ADVANCED] = Field(
        0.02,
        gt=0,
        le=1,
        description="Lines of sight of sparse points beside each batch, of its rays, where loss.free_space "
        "is more than 0.",
    )

    former_settings: ClassVar = {
        "background_even": FormerSetting(BACKGROUND_SMOOTHNESS, after="background_height"),
        "misfits_after": FormerSetting(OUTLIER_VIEWS_FROM, after="per_view_principal_point"),
        "sight_line_margin": FormerSetting(VISIBILITY_RAY_MARGIN, after="visibility_ray_fraction"),
    }
