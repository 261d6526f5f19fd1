"""The term of the loss that holds rendered depths to depth maps, by its gradients alone."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.trace.protocol import TraceGradients, TraceResult

ROUNDING = 0.005
"""Share of the depth below which a difference counts by its square, above by itself: maps are rough."""


def depth_differences(
    result: TraceResult, known_distances: Float32[np.ndarray, " r"]
) -> Float64[np.ndarray, " r"]:
    """Return by how much the Gaussians of each ray lie behind the known surface, as a share of its distance.

    That is the sum of w_i (t_i - d) / d over the hits i, w the blending weights, t the distances and d that
    of the surface: the depth sum over d minus the accumulated alpha. 0 where d is unknown.
    """
    known = known_distances > 0
    distances = np.where(known, known_distances, 1.0).astype(np.float64)
    return np.where(known, result.depth_sum / distances - (1.0 - result.transmittance), 0.0)


def add_depth_gradient(
    grad: TraceGradients,
    result: TraceResult,
    known_distances: Float32[np.ndarray, " r"],
    weight: float,
) -> TraceGradients:
    """Add the gradient of ``weight`` times the mean over all rays of sqrt(x^2 + delta^2) - delta.

    x are the :func:`depth_differences`, so that what lies before the surface loses weight, what lies behind
    it gains, and everything moves towards it; delta is :data:`ROUNDING`.
    """
    difference = depth_differences(result, known_distances)
    slope = weight / len(difference) * difference / np.sqrt(difference**2 + ROUNDING**2)
    # x = S / d - (1 - T): dx/dS = 1/d, dx/dT = 1
    by_sum, known = np.zeros_like(slope), known_distances > 0
    by_sum[known] = slope[known] / known_distances[known]
    return replace(
        grad,
        transmittance=_add(grad.transmittance, slope),
        depth_sum=_add(grad.depth_sum, by_sum),
    )


def _add(
    before: Float32[np.ndarray, " r"] | None, more: Float64[np.ndarray, " r"]
) -> Float32[np.ndarray, " r"]:
    return more.astype(np.float32) if before is None else before + more.astype(np.float32)
