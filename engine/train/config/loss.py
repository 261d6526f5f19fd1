"""Weights of the terms of the loss."""

from typing import Annotated, ClassVar

from pydantic import Field

from octasplat.engine.settings import renamed_settings
from octasplat.engine.settings.base import Settings
from octasplat.engine.settings.fields import ADVANCED, EXPERIMENTAL, Unit

SURFACE_DEPTH_NORMAL_WEIGHT = 0.05
"""Weight of ``loss.depth_normal`` for scenes of which a surface is to be made, see ``docs/surface.md``."""

DEPTH_MAP_WEIGHT = 0.1
"""Weight of ``loss.depth`` where nothing else is said, for scenes with depth maps."""


class LossWeights(Settings):
    """Weights of the loss terms; means over the batch's valid rays and channels.

    The families of the field: 0.8 L1 + 0.2 (1 - SSIM), as in "3D Gaussian Ray Tracing: Fast Tracing of
    Particle Scenes" (https://arxiv.org/abs/2407.07090), is l1 = 0.8, ssim = 0.2; the authors of REdiSplats
    (https://arxiv.org/abs/2503.12284) use 0.8 MSE + 0.2 (1 - SSIM)/2: l2 = 0.8, ssim = 0.1.
    """

    former_names: ClassVar[renamed_settings.FormerNames] = renamed_settings.LOSS
    later_settings: ClassVar[frozenset[str]] = frozenset({"depth", "edges", "free_space_from"})

    l1: Annotated[float, Unit("weight"), ADVANCED] = Field(
        0.8,
        ge=0,
        description="Weight of the mean absolute difference of display colors. Raise it against l2 where a "
        "few wrong pixels, such as passers-by, matter too much.",
    )
    l2: Annotated[float, Unit("weight"), ADVANCED] = Field(
        1.0,
        ge=0,
        description="Weight of the mean squared difference of display colors. Raise it against l1 for "
        "higher PSNR, lower it for sharper pictures.",
    )
    ssim: Annotated[float, Unit("weight"), ADVANCED] = Field(
        0.0,
        ge=0,
        description="Weight of 1 - SSIM; more than 0 makes ssim_patch_fraction of the rays whole patches, "
        "which is slower. Use it to repeat published recipes.",
    )
    opacity: Annotated[float, Unit("weight"), EXPERIMENTAL] = Field(
        0.0,
        ge=0,
        description="Weight of the mean opacity of the Gaussians that were hit, which makes unneeded ones "
        "fade. Try it where a scene has too many floaters.",
    )
    scale: Annotated[float, Unit("weight per extent"), EXPERIMENTAL] = Field(
        0.0,
        ge=0,
        description="Weight of the mean in-plane scale of the Gaussians that were hit, of the extent, which "
        "shrinks them. Try it where large ones blur the scene.",
    )
    free_space: Annotated[float, Unit("weight"), ADVANCED] = Field(
        0.0,
        ge=0,
        description="Weight of what hides the sparse points from views that show them: free space along "
        "their lines of sight. Raise it where something floats before the cameras; materials use 0.05.",
    )
    free_space_from: Annotated[float | None, Unit("hidden share"), EXPERIMENTAL] = Field(
        None,
        ge=0,
        lt=1,
        description="Share of a line of sight from which on, where it is hidden, loss.free_space counts; by "
        "default any. Lines that graze a surface are dimmed a little by the Gaussians of its outlines: try "
        "0.3 where outlines or thin parts come out too thin.",
    )
    depth: Annotated[float | None, Unit("weight"), ADVANCED] = Field(
        None,
        ge=0,
        description="Weight of the mean difference between rendered depths and depth maps, as a share of the "
        f"depth; by default {DEPTH_MAP_WEIGHT} where the scene has depth maps. Lower it where they are "
        "rough.",
    )
    edges: Annotated[float | None, Unit("weight"), EXPERIMENTAL] = Field(
        None,
        ge=0,
        description="Weight of the difference from the photographs of as many further rays as a batch has, "
        "which show harmonics, where they pass an edge; with materials of the recipe split_sum alone. Thin "
        "parts and outlines come out better, for about a fifth more time.",
    )
    depth_normal: Annotated[float, Unit("weight"), ADVANCED] = Field(
        0.0,
        ge=0,
        description="Weight of one minus the cosine between normals and what depths span; not with "
        f"materials. Set it to {SURFACE_DEPTH_NORMAL_WEIGHT} for scenes of which a surface "
        "is to be made; it takes about "
        "twice as long.",
    )
