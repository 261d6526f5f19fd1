"""Display (sRGB-encoded) and linear color values (IEC 61966-2-1), and values as bytes."""

import numpy as np
from jaxtyping import Float, UInt8


def srgb_to_linear(srgb: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Convert display (sRGB-encoded) values in [0, 1] to linear ones; values below 0 are treated as 0.

    >>> srgb_to_linear(np.array([0.0, 0.5, 1.0])).round(3)
    array([0.   , 0.214, 1.   ])
    """
    s = np.maximum(srgb.astype(np.float64), 0.0)
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return linear.astype(srgb.dtype)


def linear_to_srgb(linear: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Convert linear values to sRGB-encoded ones of the same dtype; clamps below 0, but not above 1.

    >>> linear_to_srgb(np.array([0.0, 0.214, 1.0])).round(3)
    array([0. , 0.5, 1. ])
    """
    exponent = linear.dtype.type(1 / 2.4)
    # where() evaluates both branches: the power of a value below 0 would be not-a-number, with a warning.
    power_segment = 1.055 * np.maximum(linear, 0.0031308) ** exponent - 0.055
    return np.where(linear <= 0.0031308, 12.92 * np.maximum(linear, 0.0), power_segment)


def to_bytes(values: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Convert values in [0, 1] to bytes, clipped and rounded to the nearest of 256 steps (halves to even).

    >>> to_bytes(np.array([-0.1, 0.0, 0.5, 1.0, 1.2]))
    array([  0,   0, 128, 255, 255], dtype=uint8)
    """
    return round_to_bytes(values * 255.0)


def round_to_bytes(steps: Float[np.ndarray, "*shape"]) -> UInt8[np.ndarray, "*shape"]:
    """Convert values in units of one byte step to bytes, clipped to 0 ... 255, rounded (halves to even)."""
    return np.rint(np.clip(steps, 0.0, 255.0)).astype(np.uint8)


def composite_over(
    rgb_srgb: Float[np.ndarray, "*pixels 3"],
    alpha: Float[np.ndarray, "*pixels"],
    background_srgb: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "*pixels 3"]:
    """Composite straight (not premultiplied) colors over a background; all are display values.

    >>> composite_over(np.array([[1.0, 0.0, 0.0]]), np.array([0.25]), np.array([1.0, 1.0, 1.0]))
    array([[1.  , 0.75, 0.75]])
    """
    return rgb_srgb * alpha[..., None] + background_srgb * (np.float32(1) - alpha[..., None])
