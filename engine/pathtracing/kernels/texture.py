"""Textures looked up in compiled code."""

import math

from octasplat.engine.pathtracing.kernels.kernel_args import LightArrays, MaterialArrays
from octasplat.engine.trace.kernels.native import njit_no_refcount


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def eval_texture(
    materials: LightArrays | MaterialArrays, texture: int, u: float, v: float
) -> tuple[float, float, float]:
    """Return bilinear linear value of a texture that repeats."""
    first, height, width = (
        materials.texture_sizes[texture, 0],
        materials.texture_sizes[texture, 1],
        materials.texture_sizes[texture, 2],
    )
    texels = materials.texels_linear
    # texel centers lie at halves
    x, y = (u - math.floor(u)) * width - 0.5, (v - math.floor(v)) * height - 0.5
    i, j = math.floor(x), math.floor(y)
    x, y = x - i, y - j
    left, right = int(i) % width, (int(i) + 1) % width
    high, low = int(j) % height, (int(j) + 1) % height
    a, b = first + high * width + left, first + high * width + right
    c, d = first + low * width + left, first + low * width + right
    w_a, w_b, w_c, w_d = (1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y
    return (
        w_a * texels[a, 0] + w_b * texels[b, 0] + w_c * texels[c, 0] + w_d * texels[d, 0],
        w_a * texels[a, 1] + w_b * texels[b, 1] + w_c * texels[c, 1] + w_d * texels[d, 1],
        w_a * texels[a, 2] + w_b * texels[b, 2] + w_c * texels[c, 2] + w_d * texels[d, 2],
    )
