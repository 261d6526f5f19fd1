"""Real spherical harmonics of degree 0 to 3 in the sign and order of the 3DGS family.

A Gaussian has one color for all rays with one viewer, that in the direction from there to its mean.
"""

import math

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.gaussians.model import SH_C0
from octasplat.engine.gaussians.spherical_harmonics import SH_C1, SH_C2, SH_C3
from octasplat.engine.trace.cpu.kernels.simd_sh import (
    CHANNELS,
    HARMONICS,
    accumulate_sh16,
    eval_sh16,
    write_basis_gradient16,
)
from octasplat.engine.trace.kernels.native import njit_no_refcount

SH_BYTES = HARMONICS * CHANNELS * 4


@njit_no_refcount()
def eval_sh_basis(basis: Float64[np.ndarray, " k"], count: int, x: float, y: float, z: float) -> None:
    """Write values of the first ``count`` (1, 4, 9 or 16) harmonics at the unit direction (x, y, z)."""
    basis[0] = SH_C0
    if count > 1:
        basis[1] = -SH_C1 * y
        basis[2] = SH_C1 * z
        basis[3] = -SH_C1 * x
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        basis[4] = SH_C2[0] * x * y
        basis[5] = SH_C2[1] * y * z
        basis[6] = SH_C2[2] * (2.0 * zz - xx - yy)
        basis[7] = SH_C2[3] * x * z
        basis[8] = SH_C2[4] * (xx - yy)
        if count > 9:
            basis[9] = SH_C3[0] * y * (3.0 * xx - yy)
            basis[10] = SH_C3[1] * x * y * z
            basis[11] = SH_C3[2] * y * (4.0 * zz - xx - yy)
            basis[12] = SH_C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
            basis[13] = SH_C3[4] * x * (4.0 * zz - xx - yy)
            basis[14] = SH_C3[5] * z * (xx - yy)
            basis[15] = SH_C3[6] * x * (xx - 3.0 * yy)


@njit_no_refcount(forceinline=True)
def eval_color(
    sh: Float32[np.ndarray, "n k 3"], i: int, basis: Float64[np.ndarray, " k"]
) -> tuple[float, float, float]:
    """Return display color max(0, 1/2 + sum_k sh[i, k] basis[k]) of Gaussian ``i``, three float64."""
    # all sixteen: vectors of float32; fewer are summed one by one
    if sh.shape[1] == HARMONICS:
        red, green, blue = eval_sh16(sh.ctypes.data + i * SH_BYTES, basis.ctypes.data)
        return max(0.5 + red, 0.0), max(0.5 + green, 0.0), max(0.5 + blue, 0.0)
    red = green = blue = 0.5
    for k in range(sh.shape[1]):
        red += np.float64(sh[i, k, 0]) * basis[k]
        green += np.float64(sh[i, k, 1]) * basis[k]
        blue += np.float64(sh[i, k, 2]) * basis[k]
    return max(red, 0.0), max(green, 0.0), max(blue, 0.0)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def accumulate_sh_gradient(
    gradients: Float32[np.ndarray, "u k 3"],
    i: int,
    basis: Float64[np.ndarray, " k"],
    count: int,
    color_gradient: tuple[float, float, float],
) -> None:
    """Add the gradient by the first ``count`` harmonics to row ``i``."""
    if count == HARMONICS:
        accumulate_sh16(gradients.ctypes.data + i * SH_BYTES, basis.ctypes.data, *color_gradient)
        return
    for k in range(count):
        for channel in range(3):
            gradients[i, k, channel] += basis[k] * color_gradient[channel]


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def eval_view_basis(
    basis: Float64[np.ndarray, " k"], count: int, x: float, y: float, z: float
) -> tuple[float, float, float, float]:
    """Write the first ``count`` harmonics for a mean at (x, y, z) from the viewer.

    Returns the direction there, and one over the distance. A mean at the viewer has the direction zero.
    """
    length = math.sqrt(x * x + y * y + z * z)
    scale = 1.0 / length if length > 0.0 else 0.0
    x, y, z = x * scale, y * scale, z * scale
    eval_sh_basis(basis, count, x, y, z)
    return x, y, z, scale


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def eval_ray_view_basis(
    basis: Float64[np.ndarray, " k"],
    count: int,
    to_mean: tuple[float, float, float],
    direction: tuple[float, float, float],
    t_view_origin: float,
) -> tuple[float, float, float, float]:
    """Evaluate :func:`eval_view_basis` for a ray, ``to_mean`` from its origin.

    No slope where its viewer is at infinity.
    """
    x, y, z = to_mean
    if math.isinf(t_view_origin):
        x, y, z = direction
        eval_sh_basis(basis, count, x, y, z)
        return x, y, z, 0.0
    return eval_view_basis(
        basis,
        count,
        x - t_view_origin * direction[0],
        y - t_view_origin * direction[1],
        z - t_view_origin * direction[2],
    )


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def write_basis_gradient(
    values: Float64[np.ndarray, " k"],
    sh: Float32[np.ndarray, "n k 3"],
    i: int,
    count: int,
    color_gradient: tuple[float, float, float],
) -> None:
    """Write gradients by the values of the first ``count`` harmonics of Gaussian ``i``."""
    if count == HARMONICS:
        write_basis_gradient16(values.ctypes.data, sh.ctypes.data + i * SH_BYTES, *color_gradient)
        return
    for k in range(count):
        values[k] = (
            color_gradient[0] * sh[i, k, 0]
            + color_gradient[1] * sh[i, k, 1]
            + color_gradient[2] * sh[i, k, 2]
        )


@njit_no_refcount(fastmath={"contract"})
def mean_gradient(
    basis_gradient: Float64[np.ndarray, " k"], count: int, view: tuple[float, float, float, float]
) -> tuple[float, float, float]:
    """Return the gradient by a Gaussian's mean through its viewing direction.

    ``basis_gradient`` are the gradients by the values of its harmonics; ``view`` is that direction and one
    over the distance, as :func:`eval_view_basis` gives them; 0 for a viewer at infinity, where the mean
    changes nothing.
    """
    x, y, z, scale = view

    gx, gy, gz = (
        -SH_C1 * basis_gradient[3],
        -SH_C1 * basis_gradient[1],
        SH_C1 * basis_gradient[2],
    )
    if count > 4:
        a, b, c, d, e = (
            SH_C2[0] * basis_gradient[4],
            SH_C2[1] * basis_gradient[5],
            SH_C2[2] * basis_gradient[6],
            SH_C2[3] * basis_gradient[7],
            SH_C2[4] * basis_gradient[8],
        )
        gx += a * y - 2.0 * c * x + d * z + 2.0 * e * x
        gy += a * x + b * z - 2.0 * c * y - 2.0 * e * y
        gz += b * y + 4.0 * c * z + d * x
        if count > 9:
            xx, yy, zz = x * x, y * y, z * z
            a, b, c, d = (
                SH_C3[0] * basis_gradient[9],
                SH_C3[1] * basis_gradient[10],
                SH_C3[2] * basis_gradient[11],
                SH_C3[3] * basis_gradient[12],
            )
            e, f, g = (
                SH_C3[4] * basis_gradient[13],
                SH_C3[5] * basis_gradient[14],
                SH_C3[6] * basis_gradient[15],
            )
            gx += a * 6.0 * x * y + b * y * z - c * 2.0 * x * y - d * 6.0 * x * z
            gx += e * (4.0 * zz - 3.0 * xx - yy) + f * 2.0 * x * z + g * 3.0 * (xx - yy)
            gy += a * 3.0 * (xx - yy) + b * x * z + c * (4.0 * zz - xx - 3.0 * yy) - d * 6.0 * y * z
            gy -= e * 2.0 * x * y + f * 2.0 * y * z + g * 6.0 * x * y
            gz += b * x * y + c * 8.0 * y * z + d * (6.0 * zz - 3.0 * xx - 3.0 * yy)
            gz += e * 8.0 * x * z + f * (xx - yy)
    # dv/dm = (I - v v^T) / distance
    along = gx * x + gy * y + gz * z
    return (gx - along * x) * scale, (gy - along * y) * scale, (gz - along * z) * scale
