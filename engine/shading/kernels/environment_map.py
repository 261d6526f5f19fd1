"""Colors of a map of all directions, and gradients back to its texels."""

import numpy as np
from jaxtyping import Float, Float32, Float64

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.shading.kernels.environment_levels import Lookup, look_up
from octasplat.engine.shading.kernels.split_sum import mix


@device_function(error_model="numpy")
def _place(
    texels: Float[np.ndarray, "t 3"],
    height: int,
    frame: Float64[np.ndarray, "3 3"],
    d: Float32[np.ndarray, "3"],
) -> Lookup:
    """Return where a world direction lies in the map, see :func:`look_up`."""
    right = frame[0, 0] * d[0] + frame[0, 1] * d[1] + frame[0, 2] * d[2]
    up = frame[1, 0] * d[0] + frame[1, 1] * d[1] + frame[1, 2] * d[2]
    forward = frame[2, 0] * d[0] + frame[2, 1] * d[1] + frame[2, 2] * d[2]
    return look_up(texels, 0, height, right, up, forward)


@kernel(_nrt=False, error_model="numpy")
def map_colors(
    first: int,
    last: int,
    texels: Float[np.ndarray, "t 3"],
    height: int,
    frame: Float64[np.ndarray, "3 3"],
    directions_world: Float[np.ndarray, "r 3"],
    colors: Float[np.ndarray, "r 3"],
) -> None:
    """Write bilinear colors of a map of ``height`` rows; ``frame`` is its right, up and forward as rows."""
    for r in range(first, last):
        a, b, c, d, x, y, _, _, _ = _place(texels, height, frame, directions_world[r])
        for k in range(3):
            colors[r, k] = mix(texels, a, b, c, d, x, y, k)


@kernel(error_model="numpy")
def add_to_texels(
    texels: Float[np.ndarray, "t 3"],
    height: int,
    frame: Float64[np.ndarray, "3 3"],
    directions_world: Float[np.ndarray, "r 3"],
    grad_colors: Float[np.ndarray, "r 3"],
    sums: Float64[np.ndarray, "t 3"],
) -> None:
    """Add gradients by the colors to those by the texels, in the order of the rays: always the same sums."""
    for r in range(len(directions_world)):
        red, green, blue = grad_colors[r, 0], grad_colors[r, 1], grad_colors[r, 2]
        if red == 0.0 and green == 0.0 and blue == 0.0:  # most rays end before the background
            continue
        a, b, c, d, x, y, _, _, _ = _place(texels, height, frame, directions_world[r])
        for texel, weight in (
            (a, (1.0 - x) * (1.0 - y)), (b, x * (1.0 - y)), (c, (1.0 - x) * y), (d, x * y)
        ):  # fmt: skip
            sums[texel, 0] += weight * red
            sums[texel, 1] += weight * green
            sums[texel, 2] += weight * blue
