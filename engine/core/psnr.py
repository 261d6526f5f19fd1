"""PSNR of an image against a reference, plain and after a fit of exposure and color."""

import numpy as np
from jaxtyping import Float32


def psnr(
    render: Float32[np.ndarray, "*shape 3"],
    reference: Float32[np.ndarray, "*shape 3"],
    weight: Float32[np.ndarray, "*shape"] | None = None,
) -> float:
    """Return the peak signal-to-noise ratio in dB, for a peak of 1.

    Args:
        render: Display values.
        reference: Display values.
        weight: How much each pixel counts, 0 for invalid; ``None`` counts all alike.

    Returns:
        The PSNR; infinite for images that agree wherever they count, not-a-number when no pixel counts.

    >>> reference = np.full((2, 2, 3), 0.5, np.float32)
    >>> round(psnr(reference + np.float32(0.1), reference), 3), psnr(reference, reference)
    (20.0, inf)
    """
    squared = np.square(render.astype(np.float64) - reference).mean(axis=-1)
    if weight is None:
        error = float(squared.mean())
    else:
        total = float(weight.sum(dtype=np.float64))
        if total <= 0:
            return float("nan")
        error = float((squared * weight).sum()) / total
    return float("inf") if error == 0 else float(-10.0 * np.log10(error))


def fit_color(
    render: Float32[np.ndarray, "*shape 3"],
    reference: Float32[np.ndarray, "*shape 3"],
    weight: Float32[np.ndarray, "*shape"],
) -> Float32[np.ndarray, "*shape 3"]:
    """Return the render under the gain and offset per channel that bring it closest to the reference.

    Weighted least squares, clipped to [0, 1]. Without a pixel of positive weight the render is returned
    unchanged.

    >>> reference = np.linspace(0.1, 0.9, 12, dtype=np.float32).reshape(2, 2, 3)
    >>> darker = 0.5 * reference
    >>> np.allclose(fit_color(darker, reference, np.ones((2, 2), np.float32)), reference, atol=1e-6)
    True
    """
    corrected = render.copy()
    if weight.sum(dtype=np.float64) <= 0:
        return corrected
    for channel in range(3):
        x, y = render[..., channel].astype(np.float64), reference[..., channel].astype(np.float64)
        x_mean, y_mean = np.average(x, weights=weight), np.average(y, weights=weight)
        # About the mean, so that the offset is the mean of the reference
        x -= x_mean
        variance = np.average(x * x, weights=weight)
        # A channel of one value says nothing of the gain.
        gain = np.average(x * (y - y_mean), weights=weight) / variance if variance > 0 else 0.0
        corrected[..., channel] = np.clip(gain * x + y_mean, 0.0, 1.0)
    return corrected
