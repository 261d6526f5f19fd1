"""Frames on the Earth: what a georeference's metres are in geocentric coordinates (EPSG:4978).

These are metres from the centre of the Earth, x to latitude and longitude 0, z to the north pole. Latitudes
and longitudes are on the ellipsoid of WGS 84. Of projected systems only those of UTM are known, on WGS 84,
ETRS89 or NAD83, which differ by two metres at most.
"""

import re
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.georeference import WGS84, Georeference

if TYPE_CHECKING:
    import pyproj

SEMI_MAJOR_AXIS_M = 6_378_137.0
FLATTENING = 1.0 / 298.257223563
_ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
_UTM_CODE = re.compile(r"EPSG:([0-9]{3})([0-9]{2})")
_ZONES = {"326": range(1, 61), "327": range(1, 61), "258": range(28, 39), "269": range(1, 24)}
"""By the first digits of the code: WGS 84, north and south, ETRS89 and NAD83."""
_DIFFERENCE_M = 100.0
"""Half of the step by which directions of a projected system are found: their errors are below 1e-9."""


def geocentric(latitude_deg: float, longitude_deg: float, height_m: float) -> Float64[np.ndarray, "3"]:
    """Return a position in geocentric metres.

    Args:
        latitude_deg: on the ellipsoid of WGS 84.
        longitude_deg: east of Greenwich.
        height_m: above the ellipsoid.

    >>> geocentric(0.0, 90.0, 10.0).round(3).tolist()
    [0.0, 6378147.0, 0.0]
    """
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    normal_radius = SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - _ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    across = (normal_radius + height_m) * np.cos(latitude)
    along = (normal_radius * (1.0 - _ECCENTRICITY_SQUARED) + height_m) * np.sin(latitude)
    return np.array([across * np.cos(longitude), across * np.sin(longitude), along])


def geocentric_from_metres(georeference: Georeference) -> Float64[np.ndarray, "4 4"] | None:
    """Return the similarity from metres about an anchor to geocentric metres.

    For UTM it is the one that is right at the anchor, with grid north and the scale of the grid there.

    Returns:
        None where there is no anchor, or its system is not known here.
    """
    if georeference.anchor is None or georeference.crs is None:
        return None
    if georeference.crs == WGS84:
        latitude, longitude, height = georeference.anchor
        return _east_north_up(latitude, longitude, height)
    if not _is_utm(georeference.crs):
        return None
    import pyproj  # a sixth of a second at every start otherwise

    return _grid_frame(pyproj.Proj(georeference.crs), *georeference.anchor)


def _east_north_up(latitude_deg: float, longitude_deg: float, height_m: float) -> Float64[np.ndarray, "4 4"]:
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    up = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    east = [-np.sin(longitude), np.cos(longitude), 0.0]
    frame = np.eye(4)
    frame[:3, :3] = np.stack([east, np.cross(up, east), up], axis=1)
    frame[:3, 3] = geocentric(latitude_deg, longitude_deg, height_m)
    return frame


def _is_utm(crs: str) -> bool:
    match = _UTM_CODE.fullmatch(crs)
    return match is not None and int(match[2]) in _ZONES.get(match[1], ())


def _grid_frame(
    grid: "pyproj.Proj", easting_m: float, northing_m: float, height_m: float
) -> Float64[np.ndarray, "4 4"]:
    """Return the similarity from metres about a position in a grid, along its axes, to geocentric metres."""
    step = _DIFFERENCE_M

    def at(shift_m: float) -> Float64[np.ndarray, "3"]:
        longitude, latitude = grid(easting_m, northing_m + shift_m, inverse=True)
        return geocentric(latitude, longitude, height_m)

    longitude, latitude = grid(easting_m, northing_m, inverse=True)
    frame = _east_north_up(latitude, longitude, height_m)
    along_north = (at(step) - at(-step)) / (2.0 * step)
    north = frame[:3, :3].T @ along_north  # level but for the curvature, which the difference takes out
    scale, turn = float(np.hypot(north[0], north[1])), float(np.arctan2(north[0], north[1]))
    cosine, sine = np.cos(turn), np.sin(turn)
    frame[:3, :3] = scale * frame[:3, :3] @ [[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]
    return frame
