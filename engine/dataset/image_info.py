"""What the header of an image tells, apart from what reads it and needs more libraries."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ImageInfo:
    """What the header of an image file tells.

    Attributes:
        width_px: width as stored; an EXIF orientation is not applied, as in COLMAP.
        height_px: height as stored.
        bits: 8, or 16 for all deeper formats, floating point included.
        has_alpha: whether there is an alpha channel.
        orientation: EXIF orientation, 1 if there is none.
    """

    width_px: int
    height_px: int
    bits: int
    has_alpha: bool
    orientation: int
