"""Working sizes of the photographs of a dataset."""

from dataclasses import dataclass


@dataclass(frozen=True)
class ImageSizes:
    """Photographs of one size: width and height in px, and how many there are."""

    width_px: int
    height_px: int
    count: int
