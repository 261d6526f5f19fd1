"""Real spherical harmonics of degree 0 to 3 in the sign and order of the 3DGS family."""

import numpy as np

from engine.gaussians.harmonics import SH_C1, SH_C2, SH_C3
from engine.gaussians.model import SH_C0
from engine.trace.kernels_native import lean


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
    red = green = blue = 0.5
    for k in range(sh.shape[1]):
        red += np.float64(sh[i, k, 0]) * basis[k]
        green += np.float64(sh[i, k, 1]) * basis[k]
        blue += np.float64(sh[i, k, 2]) * basis[k]
    return max(red, 0.0), max(green, 0.0), max(blue, 0.0)
