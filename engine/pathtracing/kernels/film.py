"""Sums over the paths of each pixel."""

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.compilation import kernel


@kernel(_nrt=False, error_model="numpy")
def accumulate_pixels(
    values: Float32[np.ndarray, "p c"],
    factors: Float32[np.ndarray, " p"],
    paths_per_pixel: int,
    pixels: Int64[np.ndarray, " i"],
    sums: Float64[np.ndarray, "n c"],
) -> None:
    """Add the values of the paths of each pixel to the rows ``pixels`` of ``sums``.

    ``values`` has ``paths_per_pixel`` rows a pixel, which count ``factors`` times. All is summed in
    float64, one after the other. Without factors (no rows at all) values count as they are.
    """
    for i in range(len(pixels)):
        for channel in range(values.shape[1]):
            total = 0.0
            for k in range(i * paths_per_pixel, (i + 1) * paths_per_pixel):
                total += float(values[k, channel]) * (factors[k] if len(factors) else 1.0)
            sums[pixels[i], channel] += total
