"""Frames on the Earth: what a georeference's metres are in geocentric coordinates (EPSG:4978).

These are metres from the centre of the Earth, x to latitude and longitude 0, z to the north pole. Latitudes
and longitudes are on the ellipsoid of WGS 84. Of projected systems only those of UTM are known, on WGS 84,
ETRS89 or NAD83, which differ by two metres at most. Their inverse is the series of Krueger to the sixth order
(Karney, "Transverse Mercator with an accuracy of a few nanometers",
https://doi.org/10.1007/s00190-011-0445-3, equations 11, 21 and 36).
"""

import re
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.georeference import WGS84, Georeference

SEMI_MAJOR_AXIS_M = 6_378_137.0
FLATTENING = 1.0 / 298.257223563
_ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
_UTM_SCALE = 0.9996
_FALSE_EASTING_M, _FALSE_NORTHING_SOUTH_M = 500_000.0, 10_000_000.0
_UTM_CODE = re.compile(r"EPSG:([0-9]{3})([0-9]{2})")
_SOUTH = "327"
_ZONES = {"326": range(1, 61), _SOUTH: range(1, 61), "258": range(28, 39), "269": range(1, 24)}
"""By the first digits of the code: WGS 84, north and south, ETRS89 and NAD83."""
_DIFFERENCE_M = 100.0
"""Half of the step by which directions of a projected system are found: their errors are below 1e-9."""


@dataclass(frozen=True)
class _UtmZone:
    """A zone of UTM.

    Attributes:
        number: 1 to 60.
        is_south: whether northings count from 10,000 km south of the equator.
    """

    number: int
    is_south: bool


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
    zone = _utm_zone(georeference.crs)
    return None if zone is None else _grid_frame(zone, *georeference.anchor)


def _east_north_up(latitude_deg: float, longitude_deg: float, height_m: float) -> Float64[np.ndarray, "4 4"]:
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    up = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    east = [-np.sin(longitude), np.cos(longitude), 0.0]
    frame = np.eye(4)
    frame[:3, :3] = np.stack([east, np.cross(up, east), up], axis=1)
    frame[:3, 3] = geocentric(latitude_deg, longitude_deg, height_m)
    return frame


def _utm_zone(crs: str) -> _UtmZone | None:
    match = _UTM_CODE.fullmatch(crs)
    if match is None or int(match[2]) not in _ZONES.get(match[1], ()):
        return None
    return _UtmZone(int(match[2]), match[1] == _SOUTH)


def _grid_frame(
    zone: _UtmZone, easting_m: float, northing_m: float, height_m: float
) -> Float64[np.ndarray, "4 4"]:
    """Return the similarity from metres about a position of a zone, along its grid, to geocentric metres."""
    step = _DIFFERENCE_M

    def at(shift_m: float) -> Float64[np.ndarray, "3"]:
        return geocentric(*_inverse_utm(zone, easting_m, northing_m + shift_m), height_m)

    latitude, longitude = _inverse_utm(zone, easting_m, northing_m)
    frame = _east_north_up(latitude, longitude, height_m)
    along_north = (at(step) - at(-step)) / (2.0 * step)
    north = frame[:3, :3].T @ along_north  # level but for the curvature, which the difference takes out
    scale, turn = float(np.hypot(north[0], north[1])), float(np.arctan2(north[0], north[1]))
    cosine, sine = np.cos(turn), np.sin(turn)
    frame[:3, :3] = scale * frame[:3, :3] @ [[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]
    return frame


def _inverse_utm(zone: _UtmZone, easting_m: float, northing_m: float) -> tuple[float, float]:
    """Return latitude and longitude, degrees, of a position in a zone."""
    n = FLATTENING / (2.0 - FLATTENING)
    radius = SEMI_MAJOR_AXIS_M / (1.0 + n) * (1.0 + n**2 / 4.0 + n**4 / 64.0 + n**6 / 256.0)
    start = _FALSE_NORTHING_SOUTH_M if zone.is_south else 0.0
    grid = complex(northing_m - start, easting_m - _FALSE_EASTING_M) / (_UTM_SCALE * radius)
    terms = (factor * np.sin(2 * order * grid) for order, factor in enumerate(_inverse_factors(n), 1))
    sphere = grid - sum(terms)
    xi, eta = sphere.real, sphere.imag
    conformal = np.sin(xi) / np.hypot(np.sinh(eta), np.cos(xi))  # tangent of the conformal latitude
    longitude = np.arctan2(np.sinh(eta), np.cos(xi))
    latitude = np.arctan(_tangent_of_latitude(float(conformal)))
    return float(np.degrees(latitude)), float(np.degrees(longitude)) + 6.0 * zone.number - 183.0


def _inverse_factors(n: float) -> tuple[float, ...]:
    """Return the coefficients of the inverse series in the third flattening (Karney, equation 36)."""
    return (
        n / 2 - 2 * n**2 / 3 + 37 * n**3 / 96 - n**4 / 360 - 81 * n**5 / 512 + 96199 * n**6 / 604800,
        n**2 / 48 + n**3 / 15 - 437 * n**4 / 1440 + 46 * n**5 / 105 - 1118711 * n**6 / 3870720,
        17 * n**3 / 480 - 37 * n**4 / 840 - 209 * n**5 / 4480 + 5569 * n**6 / 90720,
        4397 * n**4 / 161280 - 11 * n**5 / 504 - 830251 * n**6 / 7257600,
        4583 * n**5 / 161280 - 108847 * n**6 / 3991680,
        20648693 * n**6 / 638668800,
    )


def _tangent_of_latitude(conformal: float) -> float:
    """Return the tangent of the latitude whose conformal latitude has that tangent, by Newton's method."""
    eccentricity = np.sqrt(_ECCENTRICITY_SQUARED)
    tangent = conformal
    for _ in range(5):  # two suffice for 64 bits
        secant = np.hypot(1.0, tangent)
        sigma = np.sinh(eccentricity * np.arctanh(eccentricity * tangent / secant))
        found = tangent * np.hypot(1.0, sigma) - sigma * secant
        slope = (1.0 - _ECCENTRICITY_SQUARED) * np.hypot(1.0, found) * secant
        slope /= 1.0 + (1.0 - _ECCENTRICITY_SQUARED) * tangent**2
        tangent += (conformal - found) / slope
    return float(tangent)
