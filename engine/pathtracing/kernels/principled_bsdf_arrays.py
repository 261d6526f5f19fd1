"""The materials' functions over arrays."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.kernel_args import AlbedoTables, Bsdf
from octasplat.engine.pathtracing.kernels.principled_bsdf import (
    fresnel_dielectric,
    principled_eval,
    principled_sample,
)
from octasplat.engine.trace.kernels.native import njit_no_refcount


class BsdfArrays(NamedTuple):
    """Materials of ``n`` points, as in :class:`octasplat.engine.pathtracing.kernels.kernel_args.Bsdf`.

    A single index of refraction, substrate, choice of compensation and clear coat stands for all.
    """

    rgb: Float64[np.ndarray, "n 3"]
    metallic: Float64[np.ndarray, " n"]
    roughness: Float64[np.ndarray, " n"]
    ior: float
    substrate: int
    energy_compensation: bool
    clear_coat: float
    clear_coat_roughness: float


@njit_no_refcount(forceinline=True)
def bsdf_row(bsdf: BsdfArrays, n: int) -> Bsdf:
    """Return the material of point ``n``."""
    rgb = bsdf.rgb[n, 0], bsdf.rgb[n, 1], bsdf.rgb[n, 2]
    return Bsdf(
        rgb, bsdf.metallic[n], bsdf.roughness[n], bsdf.ior, bsdf.substrate, bsdf.energy_compensation,
        bsdf.clear_coat, bsdf.clear_coat_roughness,
    )  # fmt: skip


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
    for n in range(first, last):
        to_viewer, to_light = (o[n, 0], o[n, 1], o[n, 2]), (i[n, 0], i[n, 1], i[n, 2])
        f[n, 0], f[n, 1], f[n, 2], pdf[n] = principled_eval(to_viewer, to_light, bsdf_row(bsdf, n), tables)


@kernel(_nrt=False, error_model="numpy")
def principled_sample_array(
    first: int,
    last: int,
    o: Float64[np.ndarray, "n 3"],
    bsdf: BsdfArrays,
    tables: AlbedoTables,
    random_numbers: Float64[np.ndarray, "n 3"],
    i: Float64[np.ndarray, "n 3"],
) -> None:
    """Write :func:`principled_sample` of the rows ``first`` to ``last`` to ``i``."""
    for n in range(first, last):
        i[n, 0], i[n, 1], i[n, 2] = principled_sample(
            (o[n, 0], o[n, 1], o[n, 2]), bsdf_row(bsdf, n), tables,
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
