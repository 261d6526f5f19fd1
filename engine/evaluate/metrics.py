"""Image metrics: PSNR, SSIM in two variants, MS-SSIM and FLIP.

All take images of display values in [0, 1] and compute in float64. ``ssim`` is not one number: the papers on
Gaussian splatting pad the image with zeros, its inventors keep only windows that lie wholly inside, and the
two differ in the second decimal; both are here under names of their own. Sources:

- SSIM: "Image Quality Assessment: From Error Visibility to Structural Similarity"
  (https://doi.org/10.1109/TIP.2003.819861);
- MS-SSIM: "Multi-scale structural similarity for image quality assessment"
  (https://doi.org/10.1109/ACSSC.2003.1292216);
- FLIP: "FLIP: A Difference Evaluator for Alternating Images" (https://doi.org/10.1145/3406183).
"""

from typing import NamedTuple

import flip_evaluator
import numpy as np
from jaxtyping import Float, Float32, Float64
from scipy.ndimage import correlate1d

from octasplat.engine.core.color import to_bytes

# Window and constants of the SSIM paper; the weights are those of the MS-SSIM paper.
SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
# FLIP's default viewer: 0.7 m from a screen that is 0.7 m wide and has 3840 pixels
PIXELS_PER_DEGREE = 67.0

DEFINITIONS: dict[str, str] = {
    "psnr": "dB; 10 log10(1 / mean squared error over all valid pixels and channels), averaged over views",
    "psnr_foreground": "dB; PSNR over the valid pixels whose reference alpha is above 0.5",
    "psnr_colour_corrected": "dB; PSNR after the gain and offset of each channel that bring the render "
    "closest to the photograph: what is left when its exposure does not count",
    "ssim": "as in 3D Gaussian Splatting: Gaussian window 11, sigma 1.5, zero padding, C1 1e-4, C2 9e-4, "
    "mean over all pixels and channels",
    "ssim_valid": "the same formula over the windows that lie wholly inside the image",
    "ms_ssim": "multi-scale SSIM, five scales; null where the smaller side is 160 pixels or less",
    "flip": "mean LDR-FLIP at 67 pixels per degree; 0 is best",
    "depth_spread": "share of the covered pixels whose mean and median depth differ by more than a tenth: "
    "haze, clouds and strokes before or behind the surfaces; 0 is best",
    "images": "renders and references are rounded to 8 bits first; pixels that a mask rules out do not "
    "count, and in the neighbourhood of others they show what the reference shows",
    "training_views": "PSNR of the views that were trained on, on a fixed grid of 576 pixels of each, "
    "rendered as held-out ones are; misfits are views far worse than those around them",
    "coverage": "pixels, squared error and PSNR by the number of training views that see what a pixel of a "
    "held-out view shows from within 15 degrees; the map of it is bright where none does, dark from nine on",
    "advice": "what would help most, by these measurements",
    "mean": "the mean of the per-view values, not of pooled errors, over the views that have a finite one",
    "mean_left_out": "how many views each mean leaves out: perfect ones, wholly masked ones, and those too "
    "small for the metric",
    "mean_psnr_ci95": "95 % bootstrap interval of the mean PSNR over the views",
}
"""What each key of ``metrics.json`` means."""


class FlipError(NamedTuple):
    """The FLIP error of every pixel, in [0, 1], and its mean."""

    error: Float32[np.ndarray, "h w"]
    mean: float


def quantize_8_bit(image: Float32[np.ndarray, "h w 3"]) -> Float32[np.ndarray, "h w 3"]:
    """Return the image rounded to the values of an 8-bit file."""
    return to_bytes(image).astype(np.float32) / np.float32(255.0)


def fill_invalid(
    render: Float32[np.ndarray, "h w 3"],
    reference: Float32[np.ndarray, "h w 3"],
    weight: Float32[np.ndarray, "h w"],
) -> Float32[np.ndarray, "h w 3"]:
    """Return the render with its invalid pixels (weight 0) replaced by those of the reference.

    For metrics that look at neighbourhoods: what a mask rules out then adds no error, inside or nearby.
    Weights between 0 and 1 blend.

    >>> render, reference = np.zeros((1, 2, 3), np.float32), np.ones((1, 2, 3), np.float32)
    >>> fill_invalid(render, reference, np.array([[1.0, 0.0]], np.float32))[0, :, 0].tolist()
    [0.0, 1.0]
    """
    w = weight[..., None]
    return np.asarray(render * w + reference * (1 - w), dtype=np.float32)


def ssim(
    render: Float32[np.ndarray, "h w 3"],
    reference: Float32[np.ndarray, "h w 3"],
    weight: Float32[np.ndarray, "h w"] | None = None,
) -> float:
    """Return SSIM as in 3D Gaussian Splatting: windows reach over the border, with zero padding."""
    return ssim_both(render, reference, weight)[0]


def ssim_valid(
    render: Float32[np.ndarray, "h w 3"],
    reference: Float32[np.ndarray, "h w 3"],
    weight: Float32[np.ndarray, "h w"] | None = None,
) -> float:
    """Return SSIM as first published: only windows completely inside the image count.

    Not-a-number when the image is smaller than the window of 11 pixels.
    """
    return ssim_both(render, reference, weight)[1]


def ssim_both(
    render: Float32[np.ndarray, "h w 3"],
    reference: Float32[np.ndarray, "h w 3"],
    weight: Float32[np.ndarray, "h w"] | None = None,
) -> tuple[float, float]:
    """Return ``ssim`` and ``ssim_valid`` from one filtering, since the second is the inner part of the first.

    With ``weight``, how much each pixel counts, the means are over the windows around pixels that do;
    not-a-number where none does.
    """
    luminance, structure = _ssim_terms(render.astype(np.float64), reference.astype(np.float64))
    similarity = luminance * structure
    inner = _crop_window_margin(similarity)
    if weight is None or (weight == 1).all():
        return float(similarity.mean()), float(inner.mean()) if inner.size else float("nan")
    valid = (
        float(_weighted_channel_means(inner, _crop_window_margin(weight)).mean())
        if inner.size
        else float("nan")
    )
    return float(_weighted_channel_means(similarity, weight).mean()), valid


def ms_ssim(
    render: Float32[np.ndarray, "h w 3"],
    reference: Float32[np.ndarray, "h w 3"],
    weight: Float32[np.ndarray, "h w"] | None = None,
) -> float | None:
    """Return multi-scale SSIM over five scales, with windows completely inside the image.

    Negative means are cut to 0, per channel and scale, and the channels averaged last. With ``weight`` the
    means are over the windows around pixels that count; a pixel of a coarser scale counts by the mean of
    those that it is made of.

    Returns:
        The index, or ``None`` when the smaller side is 160 pixels or less, too small for the fifth scale, or
        when no window counts at some scale.
    """
    if min(render.shape[:2]) <= (SSIM_WINDOW - 1) * 2 ** (len(MS_SSIM_WEIGHTS) - 1):
        return None
    x, y = render.astype(np.float64), reference.astype(np.float64)
    counts = np.ones((*render.shape[:2], 1)) if weight is None else weight[..., None].astype(np.float64)
    is_whole = bool((counts == 1).all())
    product = np.ones(3)
    for scale, exponent in enumerate(MS_SSIM_WEIGHTS):
        luminance, structure = _ssim_terms(x, y)
        last = scale == len(MS_SSIM_WEIGHTS) - 1
        # Luminance counts at the coarsest scale only, as in the paper.
        values = _crop_window_margin(luminance * structure if last else structure)
        mean = (
            values.mean(axis=(0, 1))
            if is_whole
            else _weighted_channel_means(values, _crop_window_margin(counts)[..., 0])
        )
        product *= np.maximum(mean, 0.0) ** exponent
        if not last:
            x, y, counts = _downsample_by_two(x), _downsample_by_two(y), _downsample_by_two(counts)
    return float(product.mean()) if np.isfinite(product).all() else None


def flip(
    render: Float32[np.ndarray, "h w 3"],
    reference: Float32[np.ndarray, "h w 3"],
    weight: Float32[np.ndarray, "h w"] | None = None,
) -> FlipError:
    """Return LDR-FLIP: the differences that a viewer notices when the two images alternate.

    Computed by NVIDIA's own library for a screen of 67 pixels per degree. With ``weight`` the mean is over
    the pixels that count, not-a-number where none does.
    """
    error, _, _ = flip_evaluator.evaluate(
        np.ascontiguousarray(reference, dtype=np.float32),
        np.ascontiguousarray(render, dtype=np.float32),
        "LDR",
        applyMagma=False,
        computeMeanError=False,
        parameters={"ppd": PIXELS_PER_DEGREE},
    )
    error = np.asarray(error, dtype=np.float32).reshape(render.shape[:2])
    if weight is None or (weight == 1).all():
        return FlipError(error, float(error.mean(dtype=np.float64)))
    return FlipError(error, float(_weighted_channel_means(error[..., None].astype(np.float64), weight)[0]))


def _gaussian_window() -> Float64[np.ndarray, "taps"]:
    offsets = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    window = np.exp(-np.square(offsets) / (2 * SSIM_SIGMA**2))
    return np.asarray(window / window.sum())


def _gaussian_blur(image: Float64[np.ndarray, "h w 3"]) -> Float64[np.ndarray, "h w 3"]:
    window = _gaussian_window()
    for axis in (0, 1):
        image = correlate1d(image, window, axis=axis, mode="constant", cval=0.0)
    return image


def _ssim_terms(
    x: Float64[np.ndarray, "h w 3"], y: Float64[np.ndarray, "h w 3"]
) -> tuple[Float64[np.ndarray, "h w 3"], Float64[np.ndarray, "h w 3"]]:
    """Return the luminance term and the contrast-structure term of SSIM per pixel, with zero padding."""
    mean_x, mean_y = _gaussian_blur(x), _gaussian_blur(y)
    # Variances as E(x^2) - E(x)^2 under the window
    variance_x = _gaussian_blur(x * x) - mean_x * mean_x
    variance_y = _gaussian_blur(y * y) - mean_y * mean_y
    covariance = _gaussian_blur(x * y) - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (mean_x * mean_x + mean_y * mean_y + SSIM_C1)
    structure = (2 * covariance + SSIM_C2) / (variance_x + variance_y + SSIM_C2)
    return luminance, structure


def _weighted_channel_means(
    values: Float64[np.ndarray, "h w c"], weight: Float[np.ndarray, "h w"]
) -> Float64[np.ndarray, "c"]:
    """Return the weighted mean of each channel; not-a-number where the weights are 0."""
    total = float(weight.sum(dtype=np.float64))
    if total <= 0:
        return np.full(values.shape[-1], np.nan)
    return np.asarray((values * weight[..., None]).sum(axis=(0, 1)) / total)


def _crop_window_margin(values: Float[np.ndarray, "h w *c"]) -> Float[np.ndarray, "a b *c"]:
    reach = SSIM_WINDOW // 2
    return values[reach : values.shape[0] - reach, reach : values.shape[1] - reach]


def _downsample_by_two(image: Float64[np.ndarray, "h w c"]) -> Float64[np.ndarray, "a b c"]:
    """Return means of 2x2 blocks; odd sides get a black line before them, which counts as image."""
    odd = [(side % 2, 0) for side in image.shape[:2]]
    even = np.pad(image, [*odd, (0, 0)])
    # The reference implementation pads both sides and floors, which drops the padding at the far end.
    h, w = even.shape[0] // 2, even.shape[1] // 2
    return np.asarray(even.reshape(h, 2, w, 2, -1).mean(axis=(1, 3)))
