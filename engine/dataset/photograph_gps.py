"""Positions that cameras wrote into their photographs, in EXIF."""

import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image

GpsPosition = tuple[float, float, float]
"""Latitude and longitude in degrees, and height in metres."""


def read_gps(path: Path) -> GpsPosition | None:
    """Return the GPS position in the EXIF of a photograph; None where it has none with a height."""
    tags = _gps_tags(path)
    place = _latitude_longitude(tags)
    try:
        height = float(tags[ExifTags.GPS.GPSAltitude])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    if tags.get(ExifTags.GPS.GPSAltitudeRef, b"\0") in (1, 3, b"\1", b"\3"):
        height = -height  # below the sea, or below the ellipsoid; EXIF 3.0 tells these apart
    return None if place is None or not math.isfinite(height) else (*place, height)


def read_latitude_longitude(path: Path) -> tuple[float, float] | None:
    """Return the GPS latitude and longitude in the EXIF of a photograph, degrees; None where there are none.

    A position of exactly 0, 0 is what cameras write that know none.
    """
    return _latitude_longitude(_gps_tags(path))


def _gps_tags(path: Path) -> Mapping[int, Any]:
    """Return the GPS tags of a photograph; none of a file that cannot be read."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # damaged EXIF, or many pixels, none of which are decoded
            with Image.open(path) as image:
                return image.getexif().get_ifd(ExifTags.IFD.GPSInfo)
    except (
        OSError,
        KeyError,
        TypeError,
        ValueError,
        ZeroDivisionError,
        SyntaxError,
        RuntimeError,  # of the library that reads AVIF
        Image.DecompressionBombError,
    ):
        return {}


def _latitude_longitude(tags: Mapping[int, Any]) -> tuple[float, float] | None:
    try:
        latitude = _degrees(tags[ExifTags.GPS.GPSLatitude], tags[ExifTags.GPS.GPSLatitudeRef], "SN")
        longitude = _degrees(tags[ExifTags.GPS.GPSLongitude], tags[ExifTags.GPS.GPSLongitudeRef], "WE")
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    if not (abs(latitude) <= 90 and abs(longitude) <= 180):
        return None
    return None if latitude == longitude == 0 else (latitude, longitude)


def _degrees(parts: Sequence[Any], reference: Any, letters: str) -> float:
    """Return an angle of degrees, minutes and seconds; ``letters`` are the negative and the positive one.

    Raises:
        ValueError: the reference is none of the letters: on which side of zero the angle is stays open.
    """
    degrees, minutes, seconds = (float(part) for part in parts)
    letter = reference.strip("\0 ").upper() if isinstance(reference, str) else ""
    if letter not in tuple(letters):
        raise ValueError(f"{reference!r} is none of {letters}")
    sign = -1.0 if letter == letters[0] else 1.0
    return sign * (degrees + minutes / 60 + seconds / 3600)
