"""Samples of the path tracer's lights as arrays."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int32

from octasplat.engine.pathtracing.kernels.kernel_args import LightArrays
from octasplat.engine.pathtracing.kernels.lights import light_samples


class LightSamples(NamedTuple):
    """Directions and distances to lights from ``n`` points; see :func:`sample_lights`."""

    directions_world: Float64[np.ndarray, "n 3"]
    distances: Float64[np.ndarray, " n"]
    radiance_linear: Float64[np.ndarray, "n 3"]
    density: Float64[np.ndarray, " n"]
    lights: Int32[np.ndarray, " n"]


def sample_lights(
    lights: LightArrays, points_world: Float64[np.ndarray, "n 3"], uniform: Float64[np.ndarray, "n 3"]
) -> LightSamples:
    """Sample one of the lights from each point, with probabilities by what they contribute.

    The irradiance of a surface is the mean of radiance times cosine over density; where the density is 0,
    light comes from one direction only and ``radiance`` is irradiance already.
    """
    count = len(points_world)
    out = LightSamples(
        np.zeros((count, 3)),
        np.zeros(count),
        np.zeros((count, 3)),
        np.zeros(count),
        np.zeros(count, np.int32),
    )
    light_samples(lights, points_world, uniform, out[0], out[1], out[2], out[3], out[4])
    return out
