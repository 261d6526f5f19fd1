"""LDR-FLIP: how much of a difference a viewer notices when two images alternate.

After "FLIP: A Difference Evaluator for Alternating Images" (https://doi.org/10.1145/3406183). NVIDIA's own
library takes six to nine times as long and holds the interpreter's lock meanwhile. Filters are made in
float32, as there, so that the errors are the same: the root of a small difference of features would show how
they were rounded.
"""

import math
from functools import cache

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.evaluate.kernels.flip import (
    COLOR_POWER,
    GROUP,
    INVERSE_WHITE_X,
    INVERSE_WHITE_Z,
    XYZ_FROM_RGB,
    FlipFilters,
    flip_rows,
)

# Contrast sensitivity as Gaussians, each an amplitude and a width: one of Y, one of Cx, the sum of two of Cz
_CONTRAST_Y, _CONTRAST_CX, _CONTRAST_CZ = (1.0, 0.0047), (1.0, 0.0053), ((34.1, 0.04), (13.5, 0.025))
_FEATURE_WIDTH_DEG = 0.082
_REACH_SIGMAS = 3.0
_PI = np.float32(math.pi)
_MIN_ROWS = 32
"""Rows that are worth a thread: each begins with the rows of a filter's reach before its first."""


def flip_error(
    render: Float32[np.ndarray, "h w 3"],
    reference: Float32[np.ndarray, "h w 3"],
    pixels_per_degree: float,
    threads: int = 1,
) -> Float32[np.ndarray, "h w"]:
    """Return the error of each pixel in [0, 1], of display values in [0, 1].

    Args:
        render: the one image.
        reference: the other.
        pixels_per_degree: pixels of the screen in a degree of the view.
        threads: share the rows; the error is the same on any number of them.
    """
    error = np.empty(render.shape[:2], np.float32)
    images = (np.ascontiguousarray(image, np.float32) for image in (render, reference))
    run_ranges(
        flip_rows, threads, len(error), *images, flip_filters(pixels_per_degree), error, grain=_MIN_ROWS
    )
    return error


@cache
def flip_filters(pixels_per_degree: float) -> FlipFilters:
    """Return the filters for a screen that shows so many pixels in a degree of the view."""
    resolution = np.float32(pixels_per_degree)
    contrast, feature = _contrast_filters(resolution), _feature_filters(resolution)
    # an odd multiple of the group keeps the middle
    groups = max(contrast.shape[1], feature.shape[1]) / GROUP
    taps = GROUP * (2 * math.ceil((groups - 1) / 2) + 1)
    return FlipFilters(_padded(contrast, taps), _padded(feature, taps), _max_color_difference())


def _contrast_filters(pixels_per_degree: np.float32) -> Float32[np.ndarray, "4 taps"]:
    """Return the filters of Y and Cx, and the factors of the two parts of Cz's."""
    # as wide as the widest of them
    sigma_deg = math.sqrt(max(width for _, width in _CONTRAST_CZ) / (2 * math.pi**2))
    reach = math.ceil(_REACH_SIGMAS * sigma_deg * float(pixels_per_degree))
    degrees = _taps(reach) * (np.float32(1) / pixels_per_degree)
    filters: list[Float32[np.ndarray, " taps"]] = []
    for amplitude, width in (_CONTRAST_Y, _CONTRAST_CX, *_CONTRAST_CZ):
        height = np.float32(amplitude) * np.sqrt(_PI / np.float32(width))
        decay = _exp(-(_PI * _PI) * (degrees * degrees) / np.float32(width))
        # A Gaussian in two dimensions is a product, both of whose factors take the root of its height.
        filters.append((height if len(filters) < 2 else np.sqrt(height)) * decay)
    sums = [_sum(values) for values in filters]
    both = np.sqrt(sums[2] * sums[2] + sums[3] * sums[3])
    return np.stack(
        [
            values * (np.float32(1) / total)
            for values, total in zip(filters, (*sums[:2], both, both), strict=True)
        ]
    )


def _feature_filters(pixels_per_degree: np.float32) -> Float32[np.ndarray, "3 taps"]:
    """Return a Gaussian and its derivatives, whose positive and whose negative values sum to 1 each."""
    sigma = np.float32(0.5 * _FEATURE_WIDTH_DEG) * pixels_per_degree
    x = _taps(math.ceil(_REACH_SIGMAS * float(sigma)))
    gaussian = _exp(-(x * x) / (np.float32(2) * sigma * sigma))
    first, second = -x * gaussian, (x * x / (sigma * sigma) - np.float32(1)) * gaussian
    for values in (first, second):
        positive = values > 0
        values[positive] /= _sum(values[positive])
        values[~positive] /= -_sum(values[~positive])
    return np.stack([gaussian / _sum(gaussian), first, second])


def _max_color_difference() -> np.float32:
    """Return the compressed distance of pure green and pure blue, which are the farthest apart."""
    xyz = (XYZ_FROM_RGB[:, 1:].T * [INVERSE_WHITE_X, 1, INVERSE_WHITE_Z]).astype(np.float64)
    root = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), 29**2 / 108 * xyz + 4 / 29)
    lightness = 116 * root[:, 1] - 16
    # less chroma where it is dark: the Hunt effect
    a, b = 5 * lightness * (root[:, 0] - root[:, 1]), 2 * lightness * (root[:, 1] - root[:, 2])
    distance = abs(lightness[0] - lightness[1]) + math.hypot(a[0] - a[1], b[0] - b[1])
    return np.float32(distance ** float(COLOR_POWER))


def _taps(reach: int) -> Float32[np.ndarray, " taps"]:
    return np.arange(-reach, reach + 1, dtype=np.float32)


def _exp(exponents: Float32[np.ndarray, " taps"]) -> Float32[np.ndarray, " taps"]:
    """Return the exponentials, rounded correctly."""
    return np.exp(exponents.astype(np.float64)).astype(np.float32)


def _sum(values: Float32[np.ndarray, " taps"]) -> np.float32:
    """Return the sum in the order of the values."""
    return np.float32(np.cumsum(values)[-1])


def _padded(filters: Float32[np.ndarray, "k t"], taps: int) -> Float32[np.ndarray, "k taps"]:
    """Return filters of so many taps, with zeros at both ends."""
    end = (taps - filters.shape[1]) // 2
    return np.pad(filters, ((0, 0), (end, end)))
