"""Coordinate systems that files of control points state: an EPSG code, UTM in words, or a PROJ string."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import pyproj

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.georeference import WGS84

_DEGREES = (4326, 4979)
_METHODS_OF_THE_EARTH = (
    "Popular Visualisation Pseudo Mercator", "Mercator", "Equidistant Cylindrical",
    "Lambert Cylindrical Equal Area", "Equal Earth",
)  # fmt: skip
"""First words of the methods of maps of the whole Earth, whose units are metres along a line alone."""
_DIRECTIONS = (["east", "north"], ["north", "north"], ["south", "south"])
"""Of the axes, sorted; maps of a pole name the directions along two meridians."""
_EPSG = re.compile(r"EPSG", re.IGNORECASE)
_CODE = re.compile(
    r"EPSG\s*:+\s*([0-9]{4,6})(?![0-9]|\.[0-9])(?:\s*\+\s*(?:EPSG\s*:+\s*)?([0-9]{4,6}))?", re.IGNORECASE
)
"""A number, and that of heights behind it, as in EPSG:32632+5773."""
_LOCAL = re.compile(r"^local$", re.IGNORECASE)
_OTHER_SYSTEM = re.compile(
    r"\bUTM\b|\+proj|\bWGS ?84\b|\b(?:ESRI|IGNF|SR-ORG):"
    r"|\b(?:ETRS|NAD|GDA|JGD|CGCS|SIRGAS)[ _-]?[0-9]{2,4}\b",
    re.IGNORECASE,
)
"""What a comment has that says a coordinate system, known or not."""
_UTM = re.compile(r"WGS ?84(?: ?/)? ?UTM ?(?:zone )?([0-9]{1,2}) ?([NS])", re.IGNORECASE)
_ZONES, _NAD83_ZONES = range(1, 61), range(1, 24)
_PROJ_KEYS = frozenset(("proj", "zone", "south", "no_defs", "type", "wktext"))
_PROJ_VALUES: Mapping[str, frozenset[str]] = {
    "datum": frozenset(("WGS84", "NAD83")),
    "ellps": frozenset(("WGS84", "GRS80")),
    "units": frozenset(("m",)),
    "vunits": frozenset(("m",)),
    "towgs84": frozenset(("0,0,0", "0,0,0,0,0,0,0")),
}
"""Of further keys, the values that leave metres on WGS 84, or on what differs from it by two at most."""


def statement_in_comments(comments: Iterable[str]) -> str:
    """Return the comment that states a coordinate system; an empty text where none does.

    A number comes first, then a plain "local"; any other system is read or refused, so that its points are
    not taken as local.
    """
    lines = list(comments)
    patterns = (_EPSG, _LOCAL, _OTHER_SYSTEM)
    return next((line for pattern in patterns for line in lines if pattern.search(line)), "")


def parse_crs(path: Path, text: str) -> str | None:
    """Return the EPSG code that a text states; None of local metres.

    Args:
        path: the file, named in errors.
        text: a line of it.

    Raises:
        ConfigError: another coordinate system than these are read in.
    """
    if found := _CODE.search(text):
        heights = None if found.group(2) is None else int(found.group(2))
        return _checked_code(path, int(found.group(1)), heights)
    utm = _UTM.search(text)
    if utm is not None and int(utm.group(1)) in _ZONES:
        return _utm_code(326, int(utm.group(1)), utm.group(2).upper() == "S")
    if "+proj" in text and (code := _code_of_proj(text)) is not None:
        return code
    if text.strip().upper() in ("WGS84", "WGS 84"):
        return WGS84
    if text.strip().lower() in ("", "local"):
        return None
    raise ConfigError(
        f"{path}: the coordinate system {text[:60]!r} is not known; write EPSG: and its number, or local."
    )


def _checked_code(path: Path, code: int, heights_code: int | None) -> str:
    if code in _DEGREES:
        system, heights = None, _system(path, heights_code)
    else:
        system, heights = _system(path, code), _system(path, heights_code)
        assert system is not None
        if system.is_compound:
            system, heights = system.sub_crs_list[0], heights or system.sub_crs_list[1]
    upwards = [] if heights is None else [(a.direction, a.unit_conversion_factor) for a in heights.axis_info]
    if heights is not None and upwards != [("up", 1.0)]:
        raise ConfigError(f"{path}: the heights of {heights.name} are no metres upwards; write such heights.")
    if system is None:
        return WGS84
    if not system.is_projected:
        raise ConfigError(
            f"{path}: EPSG:{code} gives no metres east and north; write the points in EPSG:4326 or in a "
            "projected system, such as UTM."
        )
    method = system.coordinate_operation.method_name if system.coordinate_operation else ""
    if method.startswith(_METHODS_OF_THE_EARTH):
        raise ConfigError(
            f"{path}: lengths in EPSG:{code}, a map of the whole Earth, grow with the latitude, so "
            "that they are no metres; write the points in EPSG:4326 or in UTM."
        )
    plane = system.axis_info[:2]
    if any(axis.unit_conversion_factor != 1.0 for axis in plane):
        raise ConfigError(
            f"{path}: EPSG:{code} is in feet or another unit than metres; write the points in EPSG:4326, in "
            "UTM or in the same system in metres."
        )
    if sorted(axis.direction for axis in plane) not in _DIRECTIONS:
        raise ConfigError(
            f"{path}: EPSG:{code} counts to the west or to the south; write the points in EPSG:4326, in UTM "
            "or in another system that counts to the east and to the north."
        )
    return f"EPSG:{code}"


def _system(path: Path, code: int | None) -> pyproj.CRS | None:
    """Return the coordinate system of a number; None of None.

    Raises:
        ConfigError: PROJ's copy of the EPSG dataset has no such number.
    """
    if code is None:
        return None
    try:
        return pyproj.CRS.from_epsg(code)
    except pyproj.exceptions.CRSError:
        raise ConfigError(
            f"{path}: EPSG:{code} is no coordinate system; write the points in EPSG:4326 or in UTM."
        ) from None


def _code_of_proj(text: str) -> str | None:
    """Return the code of a PROJ string of UTM, or of degrees; None of any other."""
    words = (word.lstrip("+").partition("=") for word in text.split() if word.startswith("+"))
    given = {key: value for key, _, value in words}
    if any(value not in _PROJ_VALUES.get(key, ()) for key, value in given.items() if key not in _PROJ_KEYS):
        return None
    is_nad83 = given.get("datum") == "NAD83"
    if given.get("proj") in ("longlat", "latlong"):
        return None if is_nad83 else WGS84
    zone = int(given["zone"]) if given.get("zone", "").isdecimal() else 0
    if given.get("proj") != "utm" or zone not in (_NAD83_ZONES if is_nad83 else _ZONES):
        return None
    if is_nad83:
        return None if "south" in given else _utm_code(269, zone)
    return _utm_code(326, zone, "south" in given)


def _utm_code(family: int, zone: int, is_south: bool = False) -> str:
    return f"EPSG:{100 * (family + is_south) + zone}"
