"""The materials' functions over arrays, and the tables that they need, integrated."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.kernel_args import AlbedoTables, Bsdf
from octasplat.engine.pathtracing.kernels.principled_bsdf import (
    MIN_ALPHA,
    fresnel_dielectric,
    principled_eval,
    principled_sample,
)
from octasplat.engine.pathtracing.kernels.sampler import UINT32_TO_UNIT, reverse_bits
from octasplat.engine.shading.kernels.microfacets import ggx_masking, sample_visible_normal


class BsdfArrays(NamedTuple):
    """Materials of ``n`` points, as in :class:`octasplat.engine.pathtracing.kernels.kernel_args.Bsdf`.

    A single index of refraction, substrate and choice of compensation stands for all.
    """

    rgb: Float64[np.ndarray, "n 3"]
    metallic: Float64[np.ndarray, " n"]
    roughness: Float64[np.ndarray, " n"]
    ior: float
    substrate: int
    energy_compensation: bool


@kernel(_nrt=False, error_model="numpy")
def integrate_albedo(
    first: int, last: int, ior: float, samples: int, table: Float64[np.ndarray, "a c"]
) -> None:
    """Integrate the directional albedo of one bounce off microfacets.

    Writes the rows ``first`` to ``last`` of ``table``. Rows are roughness and columns the cosine, both from
    0 to
    1. ``ior`` 0 stands for facets that reflect everything.
    """
    rows, columns = table.shape
    for j in range(first, last):
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


@kernel(_nrt=False, error_model="numpy")
def principled_eval_array(
    first: int,
    last: int,
    o: Float64[np.ndarray, "n 3"],
    i: Float64[np.ndarray, "n 3"],
    bsdf: BsdfArrays,
    tables: AlbedoTables,
    f: Float64[np.ndarray, "n 3"],
    pdf: Float64[np.ndarray, " n"],
) -> None:
    """Write :func:`principled_eval` of the rows ``first`` to ``last`` to ``f`` and ``pdf``."""
    rgb = bsdf.rgb
    for n in range(first, last):
        here = Bsdf(
            (rgb[n, 0], rgb[n, 1], rgb[n, 2]), bsdf.metallic[n], bsdf.roughness[n],
            bsdf.ior, bsdf.substrate, bsdf.energy_compensation,
        )  # fmt: skip
        to_viewer, to_light = (o[n, 0], o[n, 1], o[n, 2]), (i[n, 0], i[n, 1], i[n, 2])
        f[n, 0], f[n, 1], f[n, 2], pdf[n] = principled_eval(to_viewer, to_light, here, tables)


@kernel(_nrt=False, error_model="numpy")
def principled_sample_array(
    first: int,
    last: int,
    o: Float64[np.ndarray, "n 3"],
    bsdf: BsdfArrays,
    coat_albedo: Float64[np.ndarray, "a c"],
    random_numbers: Float64[np.ndarray, "n 3"],
    i: Float64[np.ndarray, "n 3"],
) -> None:
    """Write :func:`principled_sample` of the rows ``first`` to ``last`` to ``i``."""
    rgb = bsdf.rgb
    for n in range(first, last):
        here = Bsdf(
            (rgb[n, 0], rgb[n, 1], rgb[n, 2]), bsdf.metallic[n], bsdf.roughness[n],
            bsdf.ior, bsdf.substrate, bsdf.energy_compensation,
        )  # fmt: skip
        i[n, 0], i[n, 1], i[n, 2] = principled_sample(
            (o[n, 0], o[n, 1], o[n, 2]), here, coat_albedo,
            random_numbers[n, 0], random_numbers[n, 1], random_numbers[n, 2],
        )  # fmt: skip


@kernel(error_model="numpy")
def fresnel_values(
    cosines: Float64[np.ndarray, " n"],
    eta: float,
    reflected: Float64[np.ndarray, " n"],
    cos_t: Float64[np.ndarray, " n"],
) -> None:
    """Write :func:`fresnel_dielectric` of rows of cosines."""
    for n in range(len(cosines)):
        reflected[n], cos_t[n] = fresnel_dielectric(cosines[n], eta)
