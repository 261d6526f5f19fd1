"""The materials' functions over arrays, and the tables that they need, integrated."""

import math

import numpy as np
from numba import prange

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.principled_bsdf import (
    MIN_ALPHA,
    fresnel_dielectric,
    principled_eval,
    principled_sample,
)
from octasplat.engine.pathtracing.kernels.sampler import UINT32_TO_UNIT, reverse_bits
from octasplat.engine.shading.kernels.microfacets import ggx_masking, sample_visible_normal


@kernel(parallel=True, error_model="numpy")
def integrate_albedo(ior, samples, table):
    """Share of light from each direction that one bounce off facets sends back, into ``table``.

    Rows are roughness and columns the cosine, both from 0 to 1. ``ior`` 0 stands for facets that reflect
    everything.
    """
    rows, columns = table.shape
    for j in prange(rows):
        roughness = j / (rows - 1)
        alpha = max(roughness * roughness, MIN_ALPHA)
        for i in range(columns):
            o_z = max(i / (columns - 1), 1e-4)
            o_x = math.sqrt(1.0 - o_z * o_z)
            total = 0.0
            for k in range(samples):
                u, v = (k + 0.5) / samples, reverse_bits(np.uint32(k)) * UINT32_TO_UNIT
                h_x, _, h_z = sample_visible_normal(o_x, 0.0, o_z, alpha, u, v)
                cos_d = o_x * h_x + o_z * h_z
                i_z = 2.0 * cos_d * h_z - o_z
                if i_z > 0.0:
                    fresnel = 1.0
                    if ior > 0.0:
                        fresnel, _ = fresnel_dielectric(cos_d, ior)
                    total += fresnel * ggx_masking(i_z, alpha)
            table[j, i] = total / samples


@kernel(parallel=True, error_model="numpy")
def principled_eval_array(
    o,
    i,
    colours,
    metallic,
    roughness,
    ior,
    substrate,
    energy_compensation,
    ggx_albedo,
    coat_albedo,
    coat_mean_albedo,
    f,
    pdf,
):
    """:func:`opaque_value` of rows of arguments, into ``f`` and ``pdf``."""
    for n in prange(len(o)):
        f[n, 0], f[n, 1], f[n, 2], pdf[n] = principled_eval(
            o[n, 0], o[n, 1], o[n, 2], i[n, 0], i[n, 1], i[n, 2], colours[n, 0], colours[n, 1], colours[n, 2],
            metallic[n], roughness[n], ior, substrate, energy_compensation, ggx_albedo, coat_albedo, coat_mean_albedo,
        )  # fmt: skip


@kernel(parallel=True, error_model="numpy")
def principled_sample_array(o, colours, metallic, roughness, coat_albedo, random_numbers, i):
    """:func:`opaque_sample` of rows of arguments; ``random_numbers`` are three uniform ones a row."""
    for n in prange(len(o)):
        i[n, 0], i[n, 1], i[n, 2] = principled_sample(
            o[n, 0], o[n, 1], o[n, 2], colours[n, 0], colours[n, 1], colours[n, 2], metallic[n], roughness[n],
            coat_albedo, random_numbers[n, 0], random_numbers[n, 1], random_numbers[n, 2],
        )  # fmt: skip


@kernel(error_model="numpy")
def fresnel_values(cosines, eta, reflected, cos_t):
    """:func:`fresnel_dielectric` of rows of cosines."""
    for n in range(len(cosines)):
        reflected[n], cos_t[n] = fresnel_dielectric(cosines[n], eta)
