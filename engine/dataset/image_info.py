"""Properties read from an image header, apart from their reader, which needs more libraries."""

from dataclasses import dataclass
from typing import Literal

Storage = Literal["8-bit", "16-bit", "float", "radiance"]
"""How an image file stores values: integers, numbers of no fixed range, or linear light (EXR, HDR)."""


@dataclass(frozen=True)
class ImageInfo:
    """Properties read from the header of an image file.

    Attributes:
        width_px: width as stored; an EXIF orientation is not applied, as in COLMAP.
        height_px: height as stored.
        bits: 8, or 16 for all deeper formats, floating point included.
        has_alpha: whether there is an alpha channel.
        orientation: EXIF orientation, 1 if there is none.
        storage: how values are stored.
    """

    width_px: int
    height_px: int
    bits: int
    has_alpha: bool
    orientation: int
    storage: Storage = "8-bit"
