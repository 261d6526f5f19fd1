"""How much each Gaussian weighs in what rays show."""

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.trace.protocol import RECORDED_RAYS_PER_BATCH, TraceGradients, Tracer


def blend_weight_sums(tracer: Tracer, rays: RayBatch, count: int) -> Float64[np.ndarray, " n"]:
    """Return the blending weight alpha T of each Gaussian, summed over rays.

    Args:
        tracer: built around the Gaussians.
        rays: of any number.
        count: number of Gaussians.
    """
    sums = np.zeros(count)
    for start in range(0, len(rays), RECORDED_RAYS_PER_BATCH):
        traced = tracer.trace(rays[start : start + RECORDED_RAYS_PER_BATCH], record=True)
        assert traced.recording is not None
        # backward of zeros: only the sums of the weights are wanted
        found = tracer.backward(traced.recording, TraceGradients(np.zeros_like(traced.rgb_srgb))).numpy()
        sums[found.ids] += found.weight_sums
        del traced, found  # the recording's memory serves the next one
    return sums
