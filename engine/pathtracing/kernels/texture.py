"""Textures looked up in compiled code."""

import math

from octasplat.engine.pathtracing.kernels.kernel_args import LightArrays, MaterialArrays
from octasplat.engine.trace.kernels.native import njit_no_refcount

TEXTURE_COLUMNS = 6
"""Numbers that describe a texture, see :class:`.kernel_args.MaterialArrays`."""
WRAP_MODES = ("repeat", "clamp", "mirror")
_CLAMP, _MIRROR = 1, 2


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def _within_turns(u: float, wrap: int) -> float:
    """Return a coordinate brought into the image, or where it is mirrored into the image and its mirror."""
    if wrap == _CLAMP:
        return min(max(u, 0.0), 1.0)
    if wrap == _MIRROR:
        return u - 2.0 * math.floor(0.5 * u)
    return u - math.floor(u)


@njit_no_refcount(forceinline=True)
def _texel_number(i: int, count: int, wrap: int) -> int:
    """Return which of ``count`` texels in a row is the one numbered ``i``, which may lie beyond them."""
    if wrap == _CLAMP:
        return min(max(i, 0), count - 1)
    if wrap == _MIRROR:
        i %= 2 * count
        return min(i, 2 * count - 1 - i)
    return i % count


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def eval_texture(
    materials: LightArrays | MaterialArrays, texture: int, u: float, v: float
) -> tuple[float, float, float]:
    """Return linear value of a texture, bilinear unless its pixels are blocks."""
    sizes = materials.texture_sizes[texture]
    first, height, width, across, down = sizes[0], sizes[1], sizes[2], sizes[3], sizes[4]
    texels = materials.texels_linear
    u, v = _within_turns(u, across), _within_turns(v, down)
    if sizes[5]:
        row, column = math.floor(v * height), math.floor(u * width)
        a = first + _texel_number(int(row), height, down) * width + _texel_number(int(column), width, across)
        return float(texels[a, 0]), float(texels[a, 1]), float(texels[a, 2])
    # texel centers lie at halves
    x, y = u * width - 0.5, v * height - 0.5
    i, j = math.floor(x), math.floor(y)
    x, y = x - i, y - j
    left, right = _texel_number(int(i), width, across), _texel_number(int(i) + 1, width, across)
    high, low = _texel_number(int(j), height, down), _texel_number(int(j) + 1, height, down)
    a, b = first + high * width + left, first + high * width + right
    c, d = first + low * width + left, first + low * width + right
    w_a, w_b, w_c, w_d = (1.0 - x) * (1.0 - y), x * (1.0 - y), (1.0 - x) * y, x * y
    return (
        w_a * texels[a, 0] + w_b * texels[b, 0] + w_c * texels[c, 0] + w_d * texels[d, 0],
        w_a * texels[a, 1] + w_b * texels[b, 1] + w_c * texels[c, 1] + w_d * texels[d, 1],
        w_a * texels[a, 2] + w_b * texels[b, 2] + w_c * texels[c, 2] + w_d * texels[d, 2],
    )
