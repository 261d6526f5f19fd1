"""Rough glass as compiled functions of directions: its values, its samples and their densities.

GGX facets that reflect and refract, with Smith's separable masking: "Microfacet Models for Refraction through
Rough Surfaces" (Walter et al. 2007). Directions are in the frame of the shading normal, ``o`` towards the
viewer (o_z > 0) and ``i`` towards the light, on either side. ``eta`` is the index of refraction on the far
side over that on the viewer's. Values are of basic radiance, hold the cosine to the light, and are pure
functions of their arguments.
"""

import math

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.principled_bsdf import fresnel_dielectric
from octasplat.engine.shading.kernels.microfacets import ggx_density, ggx_masking, sample_visible_normal
from octasplat.engine.trace.kernels.native import njit_no_refcount

MIN_GLASS_ROUGHNESS = 0.03
"""Glass of less roughness is smooth."""


@njit_no_refcount()
def rough_dielectric_eval(
    o_x: float, o_y: float, o_z: float, i_x: float, i_y: float, i_z: float, eta: float, alpha: float
) -> tuple[float, float]:
    """Return value times cosine, and the solid-angle density of :func:`rough_dielectric_sample`."""
    if o_z <= 0.0 or i_z == 0.0:
        return 0.0, 0.0
    ratio = 1.0 if i_z > 0.0 else eta  # of the half vector: of reflection, or generalized to refraction
    h_x, h_y, h_z = o_x + ratio * i_x, o_y + ratio * i_y, o_z + ratio * i_z
    length = math.sqrt(h_x * h_x + h_y * h_y + h_z * h_z)
    if length < 1e-9:
        return 0.0, 0.0
    if h_z < 0.0:  # turned to the viewer's side
        length = -length
    h_x, h_y, h_z = h_x / length, h_y / length, h_z / length
    cos_o = o_x * h_x + o_y * h_y + o_z * h_z
    cos_i = i_x * h_x + i_y * h_y + i_z * h_z
    # facets that either side would see from behind
    if cos_o <= 0.0 or cos_i * i_z <= 0.0:
        return 0.0, 0.0
    share, _ = fresnel_dielectric(min(cos_o, 1.0), eta)
    visible = ggx_density(h_z, alpha) * ggx_masking(o_z, alpha) * cos_o / o_z
    if i_z > 0.0:
        pdf = share * visible / (4.0 * cos_o)  # dh/di of reflection
    else:
        spread = cos_o + eta * cos_i
        # dh/di of refraction
        pdf = (1.0 - share) * visible * eta * eta * -cos_i / max(spread * spread, 1e-20)
    return pdf * ggx_masking(abs(i_z), alpha), pdf  # what is left of G2 is G1(i)


@njit_no_refcount()
def rough_dielectric_sample(
    o_x: float, o_y: float, o_z: float, eta: float, alpha: float, choice: float, u: float, v: float
) -> tuple[float, float, float]:
    """Draw a direction to the light, as dense as :func:`rough_dielectric_eval` says.

    It may be no direction at all (zeros). What facets reflect downwards or refract upwards is not to be taken
    for the other.
    """
    h_x, h_y, h_z = sample_visible_normal(o_x, o_y, o_z, alpha, u, v)
    cos_o = o_x * h_x + o_y * h_y + o_z * h_z
    share, cos_t = fresnel_dielectric(min(cos_o, 1.0), eta)
    if choice < share:
        up = 2.0 * cos_o * h_z - o_z
        return (2.0 * cos_o * h_x - o_x, 2.0 * cos_o * h_y - o_y, up) if up > 0.0 else (0.0, 0.0, 0.0)
    along = cos_o / eta - cos_t
    down = along * h_z - o_z / eta
    return (along * h_x - o_x / eta, along * h_y - o_y / eta, down) if down < 0.0 else (0.0, 0.0, 0.0)


@kernel(_nrt=False, error_model="numpy")
def rough_dielectric_eval_array(
    first: int,
    last: int,
    o: Float64[np.ndarray, "n 3"],
    i: Float64[np.ndarray, "n 3"],
    eta: float,
    alpha: float,
    values: Float64[np.ndarray, " n"],
    pdf: Float64[np.ndarray, " n"],
) -> None:
    """Write :func:`rough_dielectric_eval` of the rows ``first`` to ``last``."""
    for n in range(first, last):
        values[n], pdf[n] = rough_dielectric_eval(
            o[n, 0], o[n, 1], o[n, 2], i[n, 0], i[n, 1], i[n, 2], eta, alpha
        )


@kernel(_nrt=False, error_model="numpy")
def rough_dielectric_sample_array(
    first: int,
    last: int,
    o: Float64[np.ndarray, "n 3"],
    eta: float,
    alpha: float,
    random_numbers: Float64[np.ndarray, "n 3"],
    i: Float64[np.ndarray, "n 3"],
) -> None:
    """Write :func:`rough_dielectric_sample` of the rows ``first`` to ``last``."""
    for n in range(first, last):
        choice, u, v = random_numbers[n, 0], random_numbers[n, 1], random_numbers[n, 2]
        i[n, 0], i[n, 1], i[n, 2] = rough_dielectric_sample(
            o[n, 0], o[n, 1], o[n, 2], eta, alpha, choice, u, v
        )
