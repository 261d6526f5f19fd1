"""Image metrics: PSNR, SSIM in two variants, MS-SSIM and FLIP.

All take images of display values in [0, 1] and compute in float64, FLIP excepted. ``ssim`` is not one number:
the papers on Gaussian splatting pad the image with zeros, its inventors keep only windows that lie wholly
inside, and the two differ in the second decimal; both are here under names of their own. Sources:

- SSIM: "Image Quality Assessment: From Error Visibility to Structural Similarity"
  (https://doi.org/10.1109/TIP.2003.819861);
- MS-SSIM: "Multi-scale structural similarity for image quality assessment"
  (https://doi.org/10.1109/ACSSC.2003.1292216);
- FLIP: "FLIP: A Difference Evaluator for Alternating Images" (https://doi.org/10.1145/3406183).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.core.color import to_bytes
from octasplat.engine.core.compilation import run_ranges
from octasplat.engine.evaluate.flip import flip_error
from octasplat.engine.evaluate.kernels.ssim import ImagePair, SsimFilter, ssim_rows

# Window and constants of the SSIM paper; the weights are those of the MS-SSIM paper.
SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
MIN_ROWS = 16
"""Rows of an image that are worth a thread."""
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


class StructuralSimilarity(NamedTuple):
    """SSIM in both variants, and MS-SSIM, see the functions of these names."""

    ssim: float
    ssim_valid: float
    ms_ssim: float | None


class _ChannelMeans(NamedTuple):
    """Means of SSIM over all windows and over those inside the image, and of structure over the latter."""

    ssim: Float64[np.ndarray, " c"]
    ssim_valid: Float64[np.ndarray, " c"]
    structure: Float64[np.ndarray, " c"]


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
    means = _channel_means(render, reference, _weight_unless_whole(weight), threads=1)
    return float(means.ssim.mean()), float(means.ssim_valid.mean())


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
    return structural_similarity(render, reference, weight).ms_ssim


def structural_similarity(
    render: Float32[np.ndarray, "h w 3"],
    reference: Float32[np.ndarray, "h w 3"],
    weight: Float32[np.ndarray, "h w"] | None = None,
    threads: int = 1,
) -> StructuralSimilarity:
    """Return ``ssim``, ``ssim_valid`` and ``ms_ssim``, whose finest scale is filtered once for all."""
    weight = _weight_unless_whole(weight)
    means = _channel_means(render, reference, weight, threads)
    plain = float(means.ssim.mean()), float(means.ssim_valid.mean())
    if min(render.shape[:2]) <= (SSIM_WINDOW - 1) * 2 ** (len(MS_SSIM_WEIGHTS) - 1):
        return StructuralSimilarity(*plain, None)
    product = np.maximum(means.structure, 0.0) ** MS_SSIM_WEIGHTS[0]
    last = len(MS_SSIM_WEIGHTS) - 1
    for scale in range(1, last + 1):
        render, reference = _downsample_by_two(render), _downsample_by_two(reference)
        weight = None if weight is None else _downsample_by_two(weight[..., None])[..., 0]
        means = _channel_means(render, reference, weight, threads)
        # Luminance counts at the coarsest scale only, as in the paper.
        mean = means.ssim_valid if scale == last else means.structure
        product *= np.maximum(mean, 0.0) ** MS_SSIM_WEIGHTS[scale]
    return StructuralSimilarity(*plain, float(product.mean()) if np.isfinite(product).all() else None)


def flip(
    render: Float32[np.ndarray, "h w 3"],
    reference: Float32[np.ndarray, "h w 3"],
    weight: Float32[np.ndarray, "h w"] | None = None,
    threads: int = 1,
) -> FlipError:
    """Return LDR-FLIP: the differences that a viewer notices when the two images alternate.

    For a screen of 67 pixels per degree. With ``weight`` the mean is over the pixels that count,
    not-a-number where none does.
    """
    error = flip_error(render, reference, PIXELS_PER_DEGREE, threads)
    weight = _weight_unless_whole(weight)
    if weight is None:
        return FlipError(error, float(error.mean(dtype=np.float64)))
    total = float(weight.sum(dtype=np.float64))
    mean = float((error.astype(np.float64) * weight).sum()) / total if total > 0 else float("nan")
    return FlipError(error, mean)


def _gaussian_window() -> Float64[np.ndarray, "taps"]:
    offsets = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    window = np.exp(-np.square(offsets) / (2 * SSIM_SIGMA**2))
    return np.asarray(window / window.sum())


def _weight_unless_whole(
    weight: Float32[np.ndarray, "h w"] | None,
) -> Float32[np.ndarray, "h w"] | None:
    """Return the weights, or None where all pixels count."""
    return None if weight is None or (weight == 1).all() else weight


def _channel_means(
    render: Float32[np.ndarray, "h w c"],
    reference: Float32[np.ndarray, "h w c"],
    weight: Float32[np.ndarray, "h w"] | None,
    threads: int,
) -> _ChannelMeans:
    """Return the weighted means of SSIM's terms; not-a-number where no window counts."""
    height, width, channels = render.shape
    counts = np.ones((height, width), np.float32) if weight is None else weight
    # Each row is summed up by itself: the same sums on any number of threads
    sums = np.zeros((height, 3, channels))
    images = ImagePair(
        np.ascontiguousarray(render, np.float32).reshape(height, -1),
        np.ascontiguousarray(reference, np.float32).reshape(height, -1),
        np.ascontiguousarray(counts, np.float32),
    )
    run_ranges(
        ssim_rows,
        threads,
        height,
        images,
        SsimFilter(_gaussian_window(), SSIM_C1, SSIM_C2),
        sums,
        grain=MIN_ROWS,
    )
    reach = SSIM_WINDOW // 2
    inner = counts[reach : max(height - reach, 0), reach : max(width - reach, 0)]
    totals = [float(part.sum(dtype=np.float64)) for part in (counts, inner, inner)]
    return _ChannelMeans(
        *(
            part / total if total > 0 else np.full(channels, np.nan)
            for part, total in zip(sums.sum(axis=0), totals, strict=True)
        )
    )


def _downsample_by_two(image: Float32[np.ndarray, "h w c"]) -> Float32[np.ndarray, "a b c"]:
    """Return means of 2x2 blocks; odd sides get a black line before them, which counts as image."""
    odd = [(side % 2, 0) for side in image.shape[:2]]
    # The reference implementation pads both sides and floors, which drops the padding at the far end.
    even = np.pad(image, [*odd, (0, 0)]) if any(before for before, _ in odd) else image
    total = np.add(even[::2, ::2], even[1::2, ::2], dtype=np.float64)
    total += even[::2, 1::2]
    total += even[1::2, 1::2]
    return (0.25 * total).astype(np.float32)
