"""Kernels of exposures: the colors of rays as their views expose them, and the gradients of these."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.compilation import kernel


class ExposedRays(NamedTuple):
    """Rays of views, what is seen along them, and how each view exposes that.

    Attributes:
        view: of each ray.
        gains: of each view, by channel.
        offsets: of each view, by channel; what lies behind everything has none of them.
        rgb: colors along the rays before the exposure.
        transmittance: share of what is behind everything.
    """

    view: Int64[np.ndarray, " r"]
    gains: Float32[np.ndarray, "v 3"]
    offsets: Float32[np.ndarray, "v 3"]
    rgb: Float32[np.ndarray, "r 3"]
    transmittance: Float32[np.ndarray, " r"]


@kernel(error_model="numpy")
def expose_rays(rays: ExposedRays, exposed: Float32[np.ndarray, "r 3"]) -> None:
    """Write the exposed colors: gain * color + offset * what is covered."""
    view, gains, offsets, rgb, transmittance = rays
    for r in range(len(view)):
        v, alpha = view[r], np.float32(1.0) - transmittance[r]
        for c in range(3):
            exposed[r, c] = gains[v, c] * rgb[r, c] + offsets[v, c] * alpha


@kernel(error_model="numpy")
def gather_exposure_gradients(
    rays: ExposedRays,
    by_exposed: Float32[np.ndarray, "r 3"],
    by_rgb: Float32[np.ndarray, "r 3"],
    by_transmittance: Float32[np.ndarray, " r"],
    sums: Float64[np.ndarray, "v 6"],
    counts: Int64[np.ndarray, " v"],
) -> None:
    """Hand gradients on from the exposed colors to the colors and transmittances, and to the exposures.

    Args:
        rays: as they were exposed.
        by_exposed: gradients by the exposed colors.
        by_rgb: receives those by the colors.
        by_transmittance: holds the other gradients by the transmittances; what the offsets add is added.
        sums: receives those by the log gains and the offsets of each view, added up in the order of the rays.
        counts: receives the rays of each view.
    """
    view, gains, offsets, rgb, transmittance = rays
    sums[:] = 0.0
    counts[:] = 0
    for r in range(len(view)):
        v, alpha = view[r], np.float32(1.0) - transmittance[r]
        by_alpha = np.float32(0.0)
        for c in range(3):
            slope = by_exposed[r, c]
            by_rgb[r, c] = slope * gains[v, c]
            sums[v, c] += slope * gains[v, c] * rgb[r, c]
            sums[v, 3 + c] += slope * alpha
            by_alpha += slope * offsets[v, c]
        by_transmittance[r] -= by_alpha
        counts[v] += 1
