"""Which Gaussians a training begins with, and how many there may be."""

from typing import Annotated

from pydantic import Field

from octasplat.engine.settings.base import Settings
from octasplat.engine.settings.fields import ADVANCED, BASIC, EXPERIMENTAL, Unit


class GaussianSettings(Settings):
    """The first Gaussians, their colors, and their number."""

    densify_from_iter: Annotated[int, Unit("iterations"), ADVANCED] = Field(
        100, ge=0, description="Iterations of fitting the first Gaussians before anything is added."
    )
    sh_degree: Annotated[int, Unit("degree of the harmonics"), BASIC] = Field(
        3,
        ge=0,
        le=3,
        description="Degree of the spherical harmonics: how much colors may change with the direction of "
        "view, 0 not at all. Lower it for smaller files and for matt scenes.",
    )
    sh_degree_interval: Annotated[int, Unit("iterations"), ADVANCED] = Field(
        100, ge=1, description="Iterations between raising the degree of the harmonics by one."
    )
    max_gaussians: Annotated[int, Unit("Gaussians"), BASIC] = Field(
        0,
        ge=0,
        description="Most Gaussians; more show finer detail, take longer and make larger files. 0: one for "
        "each pixels_per_gaussian pixels of the training views, in small captures one for each 10 pixels up "
        "to 10,000; at most max_gaussians_auto.",
    )
    pixels_per_gaussian: Annotated[int, Unit("px per Gaussian"), ADVANCED] = Field(
        30,
        ge=10,
        description="Pixels of the training views for each Gaussian, where max_gaussians is 0. Fewer than 30 "
        "may learn the noise of the photographs.",
    )
    max_gaussians_auto: Annotated[int, Unit("Gaussians"), ADVANCED] = Field(
        400_000,
        ge=1,
        description="The most that 0 comes to in max_gaussians. Raise it for large captures, where time and "
        "memory allow.",
    )
    initial_points: Annotated[int, Unit("Gaussians"), ADVANCED] = Field(
        600_000,
        ge=1,
        description="Most points to begin from; Gaussians that are added later overlap more with those that "
        "are there.",
    )
    normal_neighbors: Annotated[int, Unit("points"), ADVANCED] = Field(
        8,
        ge=3,
        description="Points around one whose plane gives its first normal. More make smoother first normals "
        "and round corners off.",
    )
    plane_sweep_init: Annotated[bool, ADVANCED] = Field(
        True,
        description="Where the sparse model has fewer points, lift pixels of the photographs to their depth. "
        "Turn it off for scenes that reflect, whose reflections would be lifted behind the surface.",
    )
    plane_sweep_unseen: Annotated[bool, EXPERIMENTAL] = Field(
        False,
        description="Lift pixels that no neighbouring photographs show, too: where photographs are few, "
        "detail instead of smears, not always at the right place.",
    )
    initial_opacity: Annotated[float, Unit("opacity"), ADVANCED] = Field(
        0.5,
        gt=0,
        lt=1,
        description="Opacity that all Gaussians begin with. High ones suit surfaces, as with materials; low "
        "ones let the training choose among many.",
    )
    opacity_decay: Annotated[float | None, Unit("factor"), EXPERIMENTAL] = Field(
        None,
        gt=0,
        lt=1,
        description="Share of all opacities that each rebuild of the hierarchy leaves until half of the "
        "training, so that haze goes which photographs do not hold up; none leaves them alone. Try 0.99 "
        "outdoors and where photographs are few.",
    )
