"""The share of light that one bounce keeps, integrated into tables by roughness and cosine."""

import math

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.principled_bsdf import MIN_ALPHA, fresnel_dielectric
from octasplat.engine.pathtracing.kernels.sampler import UINT32_TO_UNIT, reverse_bits
from octasplat.engine.shading.kernels.microfacets import ggx_masking, sample_visible_normal
from octasplat.engine.trace.kernels.native import njit_no_refcount


@njit_no_refcount(forceinline=True)
def table_cell(roughness: float, cosine: float) -> tuple[float, float, float]:
    """Return the direction to the viewer, x and z, and the facets' alpha of a cell of a table."""
    o_z = max(cosine, 1e-4)
    return math.sqrt(1.0 - o_z * o_z), o_z, max(roughness * roughness, MIN_ALPHA)


@njit_no_refcount(forceinline=True)
def table_normal(k: int, samples: int, o_x: float, o_z: float, alpha: float) -> tuple[float, float]:
    """Return x and z of the facet's normal that is sample ``k`` of so many."""
    u, v = (k + 0.5) / samples, reverse_bits(np.uint32(k)) * UINT32_TO_UNIT  # Hammersley points
    h_x, _, h_z = sample_visible_normal(o_x, 0.0, o_z, alpha, u, v)
    return h_x, h_z


@njit_no_refcount()
def _reflected_share(o_x: float, o_z: float, alpha: float, ior: float, samples: int) -> float:
    total = 0.0
    for k in range(samples):
        h_x, h_z = table_normal(k, samples, o_x, o_z, alpha)
        cos_d = o_x * h_x + o_z * h_z
        i_z = 2.0 * cos_d * h_z - o_z  # z of o reflected at h
        if i_z > 0.0:
            fresnel = 1.0
            if ior > 0.0:
                fresnel, _ = fresnel_dielectric(cos_d, ior)
            # F G1(i): what is left of F D G2 / (4 o_z i_z) over the density of visible normals
            total += fresnel * ggx_masking(i_z, alpha)
    return total / samples


@njit_no_refcount()
def _kept_share(o_x: float, o_z: float, alpha: float, eta: float, samples: int) -> float:
    total = 0.0
    for k in range(samples):
        h_x, h_z = table_normal(k, samples, o_x, o_z, alpha)
        cos_o = o_x * h_x + o_z * h_z
        share, cos_t = fresnel_dielectric(min(cos_o, 1.0), eta)
        up = 2.0 * cos_o * h_z - o_z
        if up > 0.0:
            total += share * ggx_masking(up, alpha)
        down = (cos_o / eta - cos_t) * h_z - o_z / eta  # z of o refracted at h
        if down < 0.0:
            total += (1.0 - share) * ggx_masking(-down, alpha)
    return total / samples


@kernel(_nrt=False, error_model="numpy")
def integrate_albedo(
    first: int, last: int, ior: float, samples: int, table: Float64[np.ndarray, "a c"]
) -> None:
    """Integrate the directional albedo of one bounce off microfacets.

    Writes the rows ``first`` to ``last`` of ``table``. Rows are roughness and columns the cosine, both from
    0 to 1. ``ior`` 0 stands for facets that reflect everything.
    """
    rows, columns = table.shape
    for j in range(first, last):
        for i in range(columns):
            o_x, o_z, alpha = table_cell(j / (rows - 1), i / (columns - 1))
            table[j, i] = _reflected_share(o_x, o_z, alpha, ior, samples)


@kernel(_nrt=False, error_model="numpy")
def integrate_rough_dielectric(
    first: int, last: int, eta: float, samples: int, table: Float64[np.ndarray, "a c"]
) -> None:
    """Integrate the directional albedo of one bounce off or through microfacets.

    Rows and columns as of :func:`integrate_albedo`; ``eta`` is the index of refraction on the far side over
    that on the viewer's.
    """
    rows, columns = table.shape
    for j in range(first, last):
        for i in range(columns):
            o_x, o_z, alpha = table_cell(j / (rows - 1), i / (columns - 1))
            table[j, i] = _kept_share(o_x, o_z, alpha, eta, samples)
