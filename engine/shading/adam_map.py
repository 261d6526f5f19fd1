"""Steps of Adam for a map of all directions, and how unlike its neighbours each texel is."""

import numpy as np
from jaxtyping import Float, Float32, Float64

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-12


def adam_change(
    first: Float32[np.ndarray, "h w 3"],
    second: Float32[np.ndarray, "h w 3"],
    gradient: Float64[np.ndarray, "h w 3"],
    count: int,
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"], Float64[np.ndarray, "h w 3"]]:
    """The moments after a gradient, and the change, to be taken off, of a step of size 1.

    Args:
        first: first moments.
        second: second moments.
        gradient: of the loss by the map's values.
        count: number of this step, from 1.
    """
    first = (BETA1 * first + (1 - BETA1) * gradient).astype(np.float32)
    second = (BETA2 * second + (1 - BETA2) * gradient**2).astype(np.float32)
    mean = first.astype(np.float64) / (1 - BETA1**count)
    size = np.sqrt(second.astype(np.float64) / (1 - BETA2**count)) + EPSILON
    return first, second, mean / size


def unevenness(values: Float[np.ndarray, "h w 3"]) -> Float64[np.ndarray, "h w 3"]:
    """Four times each texel less the four beside it: the gradient of half the squared differences."""
    x = values.astype(np.float64)
    padded = np.pad(x, ((1, 1), (0, 0), (0, 0)), mode="edge")
    around = np.roll(x, 1, axis=1) + np.roll(x, -1, axis=1) + padded[:-2] + padded[2:]
    return np.asarray(4 * x - around)
