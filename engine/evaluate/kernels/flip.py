"""FLIP's error of each pixel, row by row: filtered colors, edges and points of two images compared.

In float32 and with sums in the order of NVIDIA's implementation, so that the errors are the same.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

from octasplat.engine.core.compilation import kernel
from octasplat.engine.trace.kernels.native import njit_no_refcount

TILE_PX = 256
"""Columns at once, so that the filtered rows of a tile stay in a core's cache."""
GROUP = 7
"""Taps of a filter that are added at once."""
_PLANES, _SUMS = 7, 8
"""Rows kept of each image: Y, Cx and two parts of Cz, then first and second derivative and mean of the gray
values; and what is summed down their columns: the same, with both derivatives each way."""

_ONE, _ZERO = np.float32(1.0), np.float32(0.0)
# sRGB to linear, IEC 61966-2-1
_SRGB_KNEE, _SRGB_SLOPE = np.float32(0.04045), np.float32(12.92)
_SRGB_OFFSET, _SRGB_SCALE, _SRGB_POWER = np.float32(0.055), np.float32(1.055), np.float32(2.4)
# linear sRGB to XYZ under D65, and back
XYZ_FROM_RGB = np.array(
    [[10135552, 8788810, 4435075], [2613072, 8788810, 887015], [1425312, 8788810, 70074185]], np.float32
) / np.array([[24577794], [12288897], [73733382]], np.float32)
RGB_FROM_XYZ = np.array(
    [
        [3.241003275, -1.537398934, -0.498615861],
        [-0.969224334, 1.875930071, 0.041554224],
        [0.055639423, -0.204011202, 1.057148933],
    ],
    np.float32,
)
_WHITE_X, _WHITE_Z = np.float32(0.950428545), np.float32(1.088900371)
INVERSE_WHITE_X, INVERSE_WHITE_Z = np.float32(1.052156925), np.float32(0.918357670)
# CIE L*a*b* and its linear relative Y Cx Cz
_L_SCALE, _L_OFFSET = np.float32(116.0), np.float32(16.0)
_A_SCALE, _B_SCALE = np.float32(500.0), np.float32(200.0)
_INVERSE_L_SCALE, _GRAY_OFFSET = np.float32(1 / 116), np.float32(16 / 116)
_CUBE_ROOT = np.float32(1 / 3)
_LAB_KNEE, _LAB_OFFSET = np.float32((6 / 29) ** 3), np.float32(4 / 29)
_LAB_SLOPE = _ONE / (np.float32(3.0) * np.float32(6 / 29) * np.float32(6 / 29))
_HUNT = np.float32(0.01)
"""Chroma seems less where it is dark: the Hunt effect."""
COLOR_POWER, COLOR_KNEE, COLOR_KNEE_ERROR = np.float32(0.7), np.float32(0.4), np.float32(0.95)
"""Compression of color differences: their power, and the share of the largest one that becomes this error."""
_FEATURE_SCALE = np.float32(0.5**0.5)


class FlipFilters(NamedTuple):
    """Filters along an axis, all of the same number of taps, a multiple of ``GROUP``.

    Attributes:
        contrast: contrast sensitivity of Y, Cx and both parts of Cz.
        feature: a Gaussian, its first and its second derivative.
        max_color: the largest color difference, to the power of ``COLOR_POWER``.
    """

    contrast: Float32[np.ndarray, "4 t"]
    feature: Float32[np.ndarray, "3 t"]
    max_color: np.float32


@njit_no_refcount()
def _to_linear(srgb: np.float32) -> np.float32:
    if srgb <= _SRGB_KNEE:
        return srgb / _SRGB_SLOPE
    return ((srgb + _SRGB_OFFSET) / _SRGB_SCALE) ** _SRGB_POWER


@njit_no_refcount()
def _to_xyz(
    red: np.float32, green: np.float32, blue: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    """Return X, Y and Z over those of white."""
    x = XYZ_FROM_RGB[0, 0] * red + XYZ_FROM_RGB[0, 1] * green + XYZ_FROM_RGB[0, 2] * blue
    y = XYZ_FROM_RGB[1, 0] * red + XYZ_FROM_RGB[1, 1] * green + XYZ_FROM_RGB[1, 2] * blue
    z = XYZ_FROM_RGB[2, 0] * red + XYZ_FROM_RGB[2, 1] * green + XYZ_FROM_RGB[2, 2] * blue
    return x * INVERSE_WHITE_X, y, z * INVERSE_WHITE_Z


@njit_no_refcount()
def _to_opponent(
    image: Float32[np.ndarray, "h w 3"], row: int, left: int, planes: Float32[np.ndarray, "4 n"], count: int
) -> None:
    """Write Y, Cx, Cz and the gray value in [0, 1] of pixels of a row from column ``left`` on."""
    last = image.shape[1] - 1
    for i in range(count):
        column = min(max(left + i, 0), last)
        x, y, z = _to_xyz(
            _to_linear(image[row, column, 0]),
            _to_linear(image[row, column, 1]),
            _to_linear(image[row, column, 2]),
        )
        luminance = _L_SCALE * y - _L_OFFSET
        planes[0, i] = luminance
        planes[1, i] = _A_SCALE * (x - y)
        planes[2, i] = _B_SCALE * (y - z)
        planes[3, i] = luminance * _INVERSE_L_SCALE + _GRAY_OFFSET


@njit_no_refcount()
def _add_along(
    source: Float32[np.ndarray, " m"],
    taps: Float32[np.ndarray, " t"],
    first: int,
    target: Float32[np.ndarray, " n"],
) -> None:
    """Add ``GROUP`` taps of a filter along a row, from its tap ``first`` on."""
    t0, t1, t2, t3 = taps[first], taps[first + 1], taps[first + 2], taps[first + 3]
    t4, t5, t6 = taps[first + 4], taps[first + 5], taps[first + 6]
    values = source[first : first + len(target) + GROUP - 1]
    for i in range(len(target)):
        total = target[i] + t0 * values[i]
        total += t1 * values[i + 1]
        total += t2 * values[i + 2]
        total += t3 * values[i + 3]
        total += t4 * values[i + 4]
        total += t5 * values[i + 5]
        target[i] = total + t6 * values[i + 6]


@njit_no_refcount()
def _filter_along(
    source: Float32[np.ndarray, " m"], taps: Float32[np.ndarray, " t"], target: Float32[np.ndarray, " n"]
) -> None:
    target[:] = _ZERO
    for first in range(0, len(taps), GROUP):
        _add_along(source, taps, first, target)


@njit_no_refcount()
def _filter_row(
    planes: Float32[np.ndarray, "4 m"], filters: FlipFilters, out: Float32[np.ndarray, "7 n"]
) -> None:
    """Filter the planes of a row; they begin a filter's reach before ``out``."""
    for k in range(4):
        _filter_along(planes[min(k, 2)], filters.contrast[k], out[k])
    _filter_along(planes[3], filters.feature[1], out[4])
    _filter_along(planes[3], filters.feature[2], out[5])
    _filter_along(planes[3], filters.feature[0], out[6])


@njit_no_refcount()
def _add_down(
    rows: Float32[np.ndarray, "r 2 7 n"],
    places: Int64[np.ndarray, " t"],
    image: int,
    plane: int,
    taps: Float32[np.ndarray, " t"],
    first: int,
    target: Float32[np.ndarray, " n"],
) -> None:
    """Add ``GROUP`` taps of a filter down the columns, from its tap ``first`` on."""
    t0, t1, t2, t3 = taps[first], taps[first + 1], taps[first + 2], taps[first + 3]
    t4, t5, t6 = taps[first + 4], taps[first + 5], taps[first + 6]
    r0, r1 = rows[places[first], image, plane], rows[places[first + 1], image, plane]
    r2, r3 = rows[places[first + 2], image, plane], rows[places[first + 3], image, plane]
    r4, r5 = rows[places[first + 4], image, plane], rows[places[first + 5], image, plane]
    r6 = rows[places[first + 6], image, plane]
    for i in range(len(target)):
        total = target[i] + t0 * r0[i]
        total += t1 * r1[i]
        total += t2 * r2[i]
        total += t3 * r3[i]
        total += t4 * r4[i]
        total += t5 * r5[i]
        target[i] = total + t6 * r6[i]


@njit_no_refcount()
def _filter_columns(
    rows: Float32[np.ndarray, "r 2 7 n"],
    places: Int64[np.ndarray, " t"],
    image: int,
    filters: FlipFilters,
    out: Float32[np.ndarray, "8 n"],
) -> None:
    """Filter kept rows, that of each tap at its place among them."""
    contrast, feature, _ = filters
    out[:] = _ZERO
    for first in range(0, len(places), GROUP):
        for k in range(4):
            _add_down(rows, places, image, k, contrast[k], first, out[k])
        _add_down(rows, places, image, 4, feature[0], first, out[4])
        _add_down(rows, places, image, 5, feature[0], first, out[5])
        _add_down(rows, places, image, 6, feature[1], first, out[6])
        _add_down(rows, places, image, 6, feature[2], first, out[7])


@njit_no_refcount()
def _lab_curve(value: np.float32) -> np.float32:
    if value > _LAB_KNEE:
        return value**_CUBE_ROOT
    return _LAB_SLOPE * value + _LAB_OFFSET


@njit_no_refcount()
def _clip(value: np.float32) -> np.float32:
    return min(max(value, _ZERO), _ONE)


@njit_no_refcount()
def _to_hunt_lab(
    luminance: np.float32, cx: np.float32, cz: np.float32
) -> tuple[np.float32, np.float32, np.float32]:
    """Return L*, and a* and b* by the Hunt effect, of a Y Cx Cz color cut to what a screen shows."""
    y = (luminance + _L_OFFSET) / _L_SCALE
    x = (y + cx / _A_SCALE) * _WHITE_X
    z = (y - cz / _B_SCALE) * _WHITE_Z
    red = _clip(RGB_FROM_XYZ[0, 0] * x + RGB_FROM_XYZ[0, 1] * y + RGB_FROM_XYZ[0, 2] * z)
    green = _clip(RGB_FROM_XYZ[1, 0] * x + RGB_FROM_XYZ[1, 1] * y + RGB_FROM_XYZ[1, 2] * z)
    blue = _clip(RGB_FROM_XYZ[2, 0] * x + RGB_FROM_XYZ[2, 1] * y + RGB_FROM_XYZ[2, 2] * z)
    x, y, z = _to_xyz(red, green, blue)
    x, y, z = _lab_curve(x), _lab_curve(y), _lab_curve(z)
    lightness = _L_SCALE * y - _L_OFFSET
    return (
        lightness,
        _HUNT * lightness * (_A_SCALE * (x - y)),
        _HUNT * lightness * (_B_SCALE * (y - z)),
    )


@njit_no_refcount()
def _color_difference(
    ours: Float32[np.ndarray, "8 n"], theirs: Float32[np.ndarray, "8 n"], i: int, largest: np.float32
) -> np.float32:
    """Return the HyAB distance of two filtered colors, compressed to [0, 1]."""
    l1, a1, b1 = _to_hunt_lab(ours[0, i], ours[1, i], ours[2, i] + ours[3, i])
    l2, a2, b2 = _to_hunt_lab(theirs[0, i], theirs[1, i], theirs[2, i] + theirs[3, i])
    a, b = a1 - a2, b1 - b2
    distance = (abs(l1 - l2) + np.sqrt(a * a + b * b)) ** COLOR_POWER
    knee = COLOR_KNEE * largest
    if distance < knee:
        return distance * (COLOR_KNEE_ERROR / knee)
    return COLOR_KNEE_ERROR + ((distance - knee) / (largest - knee)) * (_ONE - COLOR_KNEE_ERROR)


@njit_no_refcount()
def _length(x: np.float32, y: np.float32) -> np.float32:
    return np.sqrt(x * x + y * y)


@njit_no_refcount()
def _feature_difference(
    ours: Float32[np.ndarray, "8 n"], theirs: Float32[np.ndarray, "8 n"], i: int
) -> np.float32:
    """Return the larger difference of edges and points."""
    edge = abs(_length(ours[4, i], ours[6, i]) - _length(theirs[4, i], theirs[6, i]))
    point = abs(_length(ours[5, i], ours[7, i]) - _length(theirs[5, i], theirs[7, i]))
    return np.sqrt(_FEATURE_SCALE * max(edge, point))


@kernel(error_model="numpy")
def flip_rows(
    first: int,
    last: int,
    render: Float32[np.ndarray, "h w 3"],
    reference: Float32[np.ndarray, "h w 3"],
    filters: FlipFilters,
    error: Float32[np.ndarray, "h w"],
) -> None:
    """Write the error of the pixels in the rows ``first`` to ``last``."""
    height, width = error.shape
    taps = filters.contrast.shape[1]
    reach = taps // 2
    planes = np.empty((4, TILE_PX + 2 * reach), np.float32)
    places = np.empty(taps, np.int64)
    for left in range(0, width, TILE_PX):
        count = min(TILE_PX, width - left)
        rows = np.empty((taps, 2, _PLANES, count), np.float32)
        sums = np.empty((2, _SUMS, count), np.float32)
        ready = max(first - reach, 0)
        for y in range(first, last):
            while ready <= min(y + reach, height - 1):
                # --- colors, filtered along the row ---
                _to_opponent(reference, ready, left - reach, planes, count + 2 * reach)
                _filter_row(planes, filters, rows[ready % taps, 0])
                _to_opponent(render, ready, left - reach, planes, count + 2 * reach)
                _filter_row(planes, filters, rows[ready % taps, 1])
                ready += 1
            # --- down the columns ---
            for tap in range(taps):
                places[tap] = min(max(y + tap - reach, 0), height - 1) % taps  # edges are repeated
            for image in range(2):
                _filter_columns(rows, places, image, filters, sums[image])
            # --- compare ---
            for i in range(count):
                color = _color_difference(sums[0], sums[1], i, filters.max_color)
                feature = _feature_difference(sums[0], sums[1], i)
                error[y, left + i] = color ** (_ONE - feature)
