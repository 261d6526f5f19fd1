"""GGX microfacets and tables as compiled functions, for everything that shades or follows light.

GGX with Smith's separable masking: "Microfacet Models for Refraction through Rough Surfaces" (Walter et al.
2007). Visible normals: "Sampling Visible GGX Normals with Spherical Caps" (Dupuy and Benyoub 2023,
https://arxiv.org/abs/2306.05044).
"""

import math

import numpy as np
from jaxtyping import Float64

from octasplat.engine.trace.kernels.native import njit_no_refcount


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def schlick_weight(cosine: float) -> float:
    """(1 - cosine) to the power of 5."""
    x = min(max(1.0 - cosine, 0.0), 1.0)
    return x * x * x * x * x


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def ggx_density(cos_h: float, alpha: float) -> float:
    """Return the microfacet distribution D at a half vector of that cosine."""
    a2 = alpha * alpha
    x = cos_h * cos_h * (a2 - 1.0) + 1.0
    return a2 / (math.pi * x * x)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def ggx_masking(cosine: float, alpha: float) -> float:
    """Smith's G1: the share of the facets that face a direction and are seen from it."""
    c2 = cosine * cosine
    return 2.0 / (1.0 + math.sqrt(1.0 + alpha * alpha * max(1.0 - c2, 0.0) / max(c2, 1e-12)))


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def sample_visible_normal(
    o_x: float, o_y: float, o_z: float, alpha: float, u: float, v: float
) -> tuple[float, float, float]:
    """Return a normal of GGX as it is seen from ``o`` (o_z > 0)."""
    # to the hemisphere configuration: stretched by alpha
    x, y, z = alpha * o_x, alpha * o_y, o_z
    length = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / length, y / length, z / length
    height = (1.0 - u) * (1.0 + z) - z  # a point on the cap of the sphere seen from there, evenly
    radius = math.sqrt(min(max(1.0 - height * height, 0.0), 1.0))
    angle = 2.0 * math.pi * v
    h_x, h_y, h_z = radius * math.cos(angle) + x, radius * math.sin(angle) + y, height + z
    # back to normals of the stretched surface
    h_x, h_y, h_z = alpha * h_x, alpha * h_y, max(h_z, 1e-9)
    length = math.sqrt(h_x * h_x + h_y * h_y + h_z * h_z)
    return h_x / length, h_y / length, h_z / length


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def table_value(table: Float64[np.ndarray, "a c"], cosine: float, roughness: float) -> float:
    """Return bilinear value of a table over (roughness, cosine), both from 0 to 1."""
    rows, columns = table.shape
    y = min(max(roughness, 0.0), 1.0) * (rows - 1)
    x = min(max(cosine, 0.0), 1.0) * (columns - 1)
    j, i = min(int(y), rows - 2), min(int(x), columns - 2)
    y, x = y - j, x - i
    low = table[j, i] * (1.0 - x) + table[j, i + 1] * x
    high = table[j + 1, i] * (1.0 - x) + table[j + 1, i + 1] * x
    return low * (1.0 - y) + high * y
