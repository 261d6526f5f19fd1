"""Real spherical harmonics of degree 0 to 3 in the sign and order of the 3DGS family.

A Gaussian has one colour for all rays with one viewer, that in the direction from there to its mean.
"""

import math

import numpy as np

from octasplat.engine.gaussians.harmonics import SH_C1, SH_C2, SH_C3
from octasplat.engine.gaussians.model import SH_C0
from octasplat.engine.trace.cpu.kernels_sh_lanes import (
    CHANNELS,
    HARMONICS,
    add_harmonics,
    sum_of_harmonics,
    write_by_harmonic,
)
from octasplat.engine.trace.kernels_native import lean

SH_BYTES = HARMONICS * CHANNELS * 4


@lean()
def write_basis(basis, count, x, y, z):
    """Values of the first ``count`` (1, 4, 9 or 16) harmonics at the unit direction (x, y, z)."""
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


@lean(forceinline=True)
def colour(sh, i, basis):
    """Display colour max(0, 1/2 + sum_k sh[i, k] basis[k]) of Gaussian ``i``, three float64."""
    if sh.shape[1] == HARMONICS:
        red, green, blue = sum_of_harmonics(sh.ctypes.data + i * SH_BYTES, basis.ctypes.data)
        return max(0.5 + red, 0.0), max(0.5 + green, 0.0), max(0.5 + blue, 0.0)
    red = green = blue = 0.5
    for k in range(sh.shape[1]):
        red += np.float64(sh[i, k, 0]) * basis[k]
        green += np.float64(sh[i, k, 1]) * basis[k]
        blue += np.float64(sh[i, k, 2]) * basis[k]
    return max(red, 0.0), max(green, 0.0), max(blue, 0.0)


@lean(forceinline=True, fastmath={"contract"})
def add_by_colour(gradients, i, basis, count, by_colour):
    """Add the gradient by the first ``count`` harmonics to row ``i``."""
    if count == HARMONICS:
        add_harmonics(gradients.ctypes.data + i * SH_BYTES, basis.ctypes.data, *by_colour)
        return
    for k in range(count):
        for channel in range(3):
            gradients[i, k, channel] += basis[k] * by_colour[channel]


@lean(forceinline=True, fastmath={"contract"})
def write_view(basis, count, x, y, z):
    """The first ``count`` harmonics for a mean at (x, y, z) from the viewer.

    Returns the direction there, and one over the distance. A mean at the viewer has the direction zero.
    """
    length = math.sqrt(x * x + y * y + z * z)
    scale = 1.0 / length if length > 0.0 else 0.0
    x, y, z = x * scale, y * scale, z * scale
    write_basis(basis, count, x, y, z)
    return x, y, z, scale


@lean(forceinline=True, fastmath={"contract"})
def write_ray_view(basis, count, to_mean, direction, t_viewer):
    """:func:`write_view` for a ray, ``to_mean`` from its origin; no slope where its viewer is at infinity."""
    x, y, z = to_mean
    if math.isinf(t_viewer):
        x, y, z = direction
        write_basis(basis, count, x, y, z)
        return x, y, z, 0.0
    return write_view(
        basis, count, x - t_viewer * direction[0], y - t_viewer * direction[1], z - t_viewer * direction[2]
    )


@lean(forceinline=True, fastmath={"contract"})
def write_by_values(values, sh, i, count, by_colour):
    """Gradients by the values of the first ``count`` harmonics of Gaussian ``i``."""
    if count == HARMONICS:
        write_by_harmonic(values.ctypes.data, sh.ctypes.data + i * SH_BYTES, *by_colour)
        return
    for k in range(count):
        values[k] = by_colour[0] * sh[i, k, 0] + by_colour[1] * sh[i, k, 1] + by_colour[2] * sh[i, k, 2]


@lean(fastmath={"contract"})
def slope_by_mean(by, count, view):
    """Gradient by a Gaussian's mean, through the direction in which its colour is seen.

    ``by`` are the gradients by the values of its harmonics; ``view`` is that direction and one over the
    distance, as :func:`write_view` gives them; 0 for a viewer at infinity, where the mean changes nothing.
    """
    x, y, z, scale = view

    gx, gy, gz = (
        -SH_C1 * by[3],
        -SH_C1 * by[1],
        SH_C1 * by[2],
    )
    if count > 4:
        a, b, c, d, e = (
            SH_C2[0] * by[4],
            SH_C2[1] * by[5],
            SH_C2[2] * by[6],
            SH_C2[3] * by[7],
            SH_C2[4] * by[8],
        )
        gx += a * y - 2.0 * c * x + d * z + 2.0 * e * x
        gy += a * x + b * z - 2.0 * c * y - 2.0 * e * y
        gz += b * y + 4.0 * c * z + d * x
        if count > 9:
            xx, yy, zz = x * x, y * y, z * z
            a, b, c, d = (
                SH_C3[0] * by[9],
                SH_C3[1] * by[10],
                SH_C3[2] * by[11],
                SH_C3[3] * by[12],
            )
            e, f, g = (
                SH_C3[4] * by[13],
                SH_C3[5] * by[14],
                SH_C3[6] * by[15],
            )
            gx += a * 6.0 * x * y + b * y * z - c * 2.0 * x * y - d * 6.0 * x * z
            gx += e * (4.0 * zz - 3.0 * xx - yy) + f * 2.0 * x * z + g * 3.0 * (xx - yy)
            gy += a * 3.0 * (xx - yy) + b * x * z + c * (4.0 * zz - xx - 3.0 * yy) - d * 6.0 * y * z
            gy -= e * 2.0 * x * y + f * 2.0 * y * z + g * 6.0 * x * y
            gz += b * x * y + c * 8.0 * y * z + d * (6.0 * zz - 3.0 * xx - 3.0 * yy)
            gz += e * 8.0 * x * z + f * (xx - yy)
    along = gx * x + gy * y + gz * z
    return (gx - along * x) * scale, (gy - along * y) * scale, (gz - along * z) * scale
