"""What all photographs of a scene decide together, so that some of them can be opened without the others.

Whoever has opened all of them keeps these facts in a file; where it is read no photograph has to be there.
"""

from collections.abc import Mapping
from typing import Literal

from pydantic import BaseModel, ConfigDict

from octasplat.engine.dataset.image_info import ImageInfo, Storage

ViewFiles = tuple[str, str | None, str | None]
"""Paths of a view's photograph, mask and depth map below the folder of the scene."""


class PhotographFacts(BaseModel):
    """Facts on the photographs of a scene, those of single views in the order of the views.

    Attributes:
        files: of each view.
        infos: headers of the photographs.
        scales: stored value of full brightness, and whether values are display values, by storage; see
            :mod:`octasplat.engine.dataset.value_scale`.
        has_alpha: whether any pixel can have an alpha below 1 by its photograph.
        depth_units_world: world units for one unit of each view's depth map; None without depth maps.
        have_depths: which depth maps hold a depth at all.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1] = 1
    files: tuple[ViewFiles, ...]
    infos: tuple[ImageInfo, ...]
    scales: Mapping[Storage, tuple[float, bool]]
    has_alpha: bool
    depth_units_world: tuple[float, ...] | None = None
    have_depths: tuple[bool, ...] = ()
