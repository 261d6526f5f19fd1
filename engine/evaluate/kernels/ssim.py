"""Window means, variances and covariance of two images, and the terms of SSIM, row by row."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.core.compilation import kernel
from octasplat.engine.trace.kernels.native import njit_no_refcount

SIMILARITY, INNER_SIMILARITY, INNER_STRUCTURE = range(3)
"""Sums of a row: SSIM over all windows and over those inside the image, and structure over the latter."""


class ImagePair(NamedTuple):
    """Two images, their channels side by side in each row, and how much each pixel counts."""

    render: Float32[np.ndarray, "h wc"]
    reference: Float32[np.ndarray, "h wc"]
    weight: Float32[np.ndarray, "h w"]


class SsimFilter(NamedTuple):
    """The window along an axis, of an odd number of taps, and the constants of both terms."""

    window: Float64[np.ndarray, " taps"]
    c1: float
    c2: float


@njit_no_refcount()
def _add_moments(
    row: Float32[np.ndarray, " n"],
    tap: float,
    first: Float64[np.ndarray, " n"],
    second: Float64[np.ndarray, " n"],
) -> None:
    for i in range(len(first)):
        value = np.float64(row[i])
        first[i] += tap * value
        second[i] += tap * (value * value)


@njit_no_refcount()
def _add_products(
    row: Float32[np.ndarray, " n"],
    other: Float32[np.ndarray, " n"],
    tap: float,
    products: Float64[np.ndarray, " n"],
) -> None:
    for i in range(len(products)):
        products[i] += tap * (np.float64(row[i]) * np.float64(other[i]))


@njit_no_refcount()
def _scale(source: Float64[np.ndarray, " n"], tap: float, target: Float64[np.ndarray, " n"]) -> None:
    for i in range(len(target)):
        target[i] = tap * source[i]


@njit_no_refcount()
def _add_both_sides(
    before: Float64[np.ndarray, " n"],
    behind: Float64[np.ndarray, " n"],
    tap: float,
    target: Float64[np.ndarray, " n"],
) -> None:
    for i in range(len(target)):
        target[i] += tap * (before[i] + behind[i])


@njit_no_refcount()
def _luminance(
    mean_x: Float64[np.ndarray, " n"],
    mean_y: Float64[np.ndarray, " n"],
    c1: float,
    out: Float64[np.ndarray, " n"],
) -> None:
    for i in range(len(out)):
        x, y = mean_x[i], mean_y[i]
        out[i] = (2.0 * x * y + c1) / (x * x + y * y + c1)


@njit_no_refcount()
def _structure(blurred: Float64[np.ndarray, "5 n"], c2: float, out: Float64[np.ndarray, " n"]) -> None:
    mean_x, mean_y, square_x, square_y, product = blurred[0], blurred[1], blurred[2], blurred[3], blurred[4]
    for i in range(len(out)):
        x, y = mean_x[i], mean_y[i]
        # variances as E(x^2) - E(x)^2 under the window
        variances = (square_x[i] - x * x) + (square_y[i] - y * y)
        out[i] = (2.0 * (product[i] - x * y) + c2) / (variances + c2)


@njit_no_refcount()
def _add_up(
    luminance: Float64[np.ndarray, " n"],
    structure: Float64[np.ndarray, " n"],
    weight: Float32[np.ndarray, " w"],
    reach: int,
    is_inner_row: bool,
    sums: Float64[np.ndarray, "3 c"],
) -> None:
    channels = sums.shape[1]
    for channel in range(channels):
        whole = inner = inner_structure = 0.0
        for x in range(len(weight)):
            i = channels * x + channel
            similarity = luminance[i] * structure[i] * weight[x]
            whole += similarity
            if is_inner_row and reach <= x < len(weight) - reach:
                inner += similarity
                inner_structure += structure[i] * weight[x]
        sums[SIMILARITY, channel], sums[INNER_SIMILARITY, channel] = whole, inner
        sums[INNER_STRUCTURE, channel] = inner_structure


@kernel(error_model="numpy")
def ssim_rows(
    first: int, last: int, images: ImagePair, ssim_filter: SsimFilter, sums: Float64[np.ndarray, "h 3 c"]
) -> None:
    """Write the weighted sums of SSIM's terms over the rows ``first`` to ``last``, with zero padding."""
    render, reference, weight = images
    window, c1, c2 = ssim_filter
    height, count = render.shape
    channels, reach = sums.shape[2], len(window) // 2
    margin = reach * channels
    # both images, their squares, and their product; the margins stay 0
    columns = np.zeros((5, count + 2 * margin))
    blurred = np.empty((5, count))
    luminance, structure = np.empty(count), np.empty(count)
    for y in range(first, last):
        # --- down the columns ---
        columns[:, margin : margin + count] = 0.0
        for tap in range(len(window)):
            row = y + tap - reach
            if 0 <= row < height:
                _add_moments(
                    render[row],
                    window[tap],
                    columns[0, margin : margin + count],
                    columns[2, margin : margin + count],
                )
                _add_moments(
                    reference[row],
                    window[tap],
                    columns[1, margin : margin + count],
                    columns[3, margin : margin + count],
                )
                _add_products(render[row], reference[row], window[tap], columns[4, margin : margin + count])
        # --- along the row ---
        for k in range(5):
            _scale(columns[k, margin : margin + count], window[reach], blurred[k])
            for apart in range(1, reach + 1):
                before, behind = margin - apart * channels, margin + apart * channels
                _add_both_sides(
                    columns[k, before : before + count],
                    columns[k, behind : behind + count],
                    window[reach + apart],
                    blurred[k],
                )
        _luminance(blurred[0], blurred[1], c1, luminance)
        _structure(blurred, c2, structure)
        _add_up(luminance, structure, weight[y], reach, reach <= y < height - reach, sums[y])
