"""What a render says beside its photograph: PSNR after each fit, and the power of both by spatial frequency.

The power tells which detail a render lacks, and the power of the difference at which detail it is wrong.
Bands are octaves of the radial frequency, in cycles a pixel: the last one ends at Nyquist's 0.5 and takes
the corners beyond it with it. A picture is taken less its mean, under a Hann window, so that its edges count
little.
"""

import numpy as np
from jaxtyping import Float32, Float64

from benchmarks.picture_fits import (
    Picture,
    Weight,
    fit_affine_color,
    fit_homography,
    fit_local_gain,
    fit_local_motion,
    fit_shift,
)
from octasplat.engine.core.psnr import fit_color, psnr
from octasplat.engine.evaluate.metrics import quantize_8_bit

BAND_EDGES = (0.0, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 0.5)
"""Cycles a pixel at which the bands begin; the last number ends the last of them."""
BAND_NAMES = ("coarser than 32 px", "16 to 32 px", "8 to 16 px", "4 to 8 px", "finer than 4 px")
"""The bands by the lengths of their waves."""


def band_powers(picture: Float32[np.ndarray, "h w 3"]) -> Float64[np.ndarray, " b"]:
    """Return the mean power of a picture's pixels in each band; the sum is its windowed variance."""
    height, width = picture.shape[:2]
    window = np.hanning(height + 2)[1:-1, None] * np.hanning(width + 2)[None, 1:-1]
    share = window / np.sqrt(np.square(window).mean())
    radius = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None, :])
    band = np.clip(np.searchsorted(BAND_EDGES, radius.reshape(-1), side="right") - 1, 0, len(BAND_NAMES) - 1)
    powers = np.zeros(len(BAND_NAMES))
    for channel in range(3):
        values = picture[..., channel].astype(np.float64)
        values -= np.average(values, weights=window)
        power = np.square(np.abs(np.fft.fft2(values * share))).reshape(-1) / values.size**2
        powers += np.bincount(band, power, minlength=len(powers)) / 3
    return powers


def sharpness_db(
    render: Float32[np.ndarray, "h w 3"], reference: Float32[np.ndarray, "h w 3"]
) -> Float64[np.ndarray, " b"]:
    """Return how much more power than the photograph the render has in each band, dB; blur is below 0."""
    floor = 1e-12
    return np.asarray(10 * np.log10((band_powers(render) + floor) / (band_powers(reference) + floor)))


def error_shares(
    render: Float32[np.ndarray, "h w 3"], reference: Float32[np.ndarray, "h w 3"]
) -> Float64[np.ndarray, " b"]:
    """Return the share of the squared error (less its mean) that lies in each band."""
    powers = band_powers((render - reference).astype(np.float32))
    return np.asarray(powers / max(float(powers.sum()), 1e-30))


def measure_pair(render: Picture, reference: Picture, weight: Weight) -> dict[str, float | list[float]]:
    """Return PSNR as it is and after each fit (dB), the motions that were found (px), and the spectra.

    Pictures are rounded to 8 bits, as they are in files, before they are compared.
    """

    def left(picture: Picture) -> float:
        return psnr(quantize_8_bit(picture), reference, weight)

    shift, homography = (fit(render, reference, weight) for fit in (fit_shift, fit_homography))
    even = fit_local_gain(render, reference, weight)
    moved, moved_px = fit_local_motion(render, reference, weight)
    shown = np.where(weight[..., None] > 0, render, reference)
    return {
        "psnr": left(render),
        "gain_and_offset": left(fit_color(render, reference, weight)),
        "affine_color": left(fit_affine_color(render, reference, weight)),
        "local_gain": left(even),
        "shift": left(shift.picture),
        "homography": left(homography.picture),
        "local_motion": left(moved),
        "color_and_motion": left(fit_local_motion(even, reference, weight)[0]),
        "shift_px": list(shift.shift_px),
        "homography_corner_px": homography.corner_px,
        "local_motion_px": moved_px,
        "sharpness_db": sharpness_db(shown, reference).tolist(),
        "error_by_band": error_shares(shown, reference).tolist(),
    }
