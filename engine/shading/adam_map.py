"""Steps of Adam for a map of all directions, and how unlike its neighbours each texel is."""

import numpy as np
from jaxtyping import Float, Float32, Float64

BETA1, BETA2, EPSILON = 0.9, 0.99, 1e-12


def adam_update(
    exp_avg: Float32[np.ndarray, "h w 3"],
    exp_avg_sq: Float32[np.ndarray, "h w 3"],
    gradient: Float64[np.ndarray, "h w 3"],
    step: int,
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w 3"], Float64[np.ndarray, "h w 3"]]:
    """Return the moments after a gradient, and the change of a step of size 1, to be subtracted.

    Args:
        exp_avg: first moments.
        exp_avg_sq: second moments.
        gradient: of the loss by the map's values.
        step: number of this step, from 1.
    """
    exp_avg = (BETA1 * exp_avg + (1 - BETA1) * gradient).astype(np.float32)
    exp_avg_sq = (BETA2 * exp_avg_sq + (1 - BETA2) * gradient**2).astype(np.float32)
    mean = exp_avg.astype(np.float64) / (1 - BETA1**step)
    size = np.sqrt(exp_avg_sq.astype(np.float64) / (1 - BETA2**step)) + EPSILON
    return exp_avg, exp_avg_sq, mean / size


def smoothness_gradient(values: Float[np.ndarray, "h w 3"]) -> Float64[np.ndarray, "h w 3"]:
    """Return four times each texel less the four beside it: the gradient of half the squared differences."""
    x = values.astype(np.float64)
    padded = np.pad(x, ((1, 1), (0, 0), (0, 0)), mode="edge")  # no wrap over the poles; columns go around
    neighbor_sum = np.roll(x, 1, axis=1) + np.roll(x, -1, axis=1) + padded[:-2] + padded[2:]
    return np.asarray(4 * x - neighbor_sum)
