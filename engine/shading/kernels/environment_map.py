"""Colours of a map of all directions, and gradients back to its texels."""

from numba import prange

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.shading.kernels.environment_levels import look_up
from octasplat.engine.shading.kernels.split_sum import mix


@device_function(error_model="numpy")
def _place(texels, height, frame, d):
    """Where a world direction lies in the map, see :func:`look_up`."""
    right = frame[0, 0] * d[0] + frame[0, 1] * d[1] + frame[0, 2] * d[2]
    up = frame[1, 0] * d[0] + frame[1, 1] * d[1] + frame[1, 2] * d[2]
    forward = frame[2, 0] * d[0] + frame[2, 1] * d[1] + frame[2, 2] * d[2]
    return look_up(texels, 0, height, right, up, forward)


@kernel(parallel=True, error_model="numpy")
def map_colours(texels, height, frame, directions_world, colours):
    """Bilinear colours of a map of ``height`` rows; ``frame`` is its right, up and forward as rows."""
    for r in prange(len(directions_world)):
        a, b, c, d, x, y, _, _, _ = _place(texels, height, frame, directions_world[r])
        for k in range(3):
            colours[r, k] = mix(texels, a, b, c, d, x, y, k)


@kernel(error_model="numpy")
def add_to_texels(texels, height, frame, directions_world, by_colours, sums):
    """Add gradients by the colours to those by the texels, in the order of the rays: always the same sums."""
    for r in range(len(directions_world)):
        red, green, blue = by_colours[r, 0], by_colours[r, 1], by_colours[r, 2]
        if red == 0.0 and green == 0.0 and blue == 0.0:
            continue
        a, b, c, d, x, y, _, _, _ = _place(texels, height, frame, directions_world[r])
        for texel, weight in (
            (a, (1.0 - x) * (1.0 - y)), (b, x * (1.0 - y)), (c, (1.0 - x) * y), (d, x * y)
        ):  # fmt: skip
            sums[texel, 0] += weight * red
            sums[texel, 1] += weight * green
            sums[texel, 2] += weight * blue
