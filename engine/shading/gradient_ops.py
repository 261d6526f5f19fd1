"""Gradients of the display curve, and clipping of gradients that are much longer than their median."""

import numpy as np
from jaxtyping import Float64


def clip_gradients(
    gradients: Float64[np.ndarray, "p 3"], max_median_ratio: float
) -> Float64[np.ndarray, "p 3"]:
    """Return gradients no longer than ``max_median_ratio`` times the median of those that are not 0.

    A ratio of 0 leaves them alone.

    A pixel that shows a mirror in a mirror has a far longer gradient than others, and is as likely to be
    wrong.
    """
    lengths = np.linalg.norm(gradients, axis=1)
    if max_median_ratio == 0 or not (lengths > 0).any():
        return gradients
    longest = max_median_ratio * float(np.median(lengths[lengths > 0]))
    return gradients * np.minimum(1.0, longest / np.maximum(lengths, 1e-30))[:, None]


def srgb_derivative(linear: Float64[np.ndarray, "*shape"]) -> Float64[np.ndarray, "*shape"]:
    """Return the derivative of display by linear values; beyond white that at white, so light can fall."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92, (1.055 / 2.4) * np.maximum(x, 0.0031308) ** (1 / 2.4 - 1))
