"""Real spherical harmonics, and their rotation with a Gaussian.

Within one degree the harmonics span a space that every rotation, and every reflection, maps onto itself. So
the matrix that turns coefficients follows from sampling: the turned function takes, at a direction d, the
value that the old one had at O^T d, and 2l + 1 or more directions in general position fix its coefficients.
That needs no recursion over degrees and holds for whatever signs and order the basis has.
"""

import math
from functools import cache

import numpy as np
from jaxtyping import Float, Float32

from octasplat.engine.gaussians.model import SH_C0

ROWS_PER_BATCH = 65536
# Degree 3 needs at least 7.
SAMPLE_DIRECTIONS = 16


def _normalization(numerator: int, denominator: int) -> float:
    return math.sqrt(numerator / (denominator * math.pi))


SH_C1 = _normalization(3, 4)
SH_C2 = (
    _normalization(15, 4),
    -_normalization(15, 4),
    _normalization(5, 16),
    -_normalization(15, 4),
    _normalization(15, 4) / 2,
)
SH_C3 = (
    -_normalization(35, 32),
    _normalization(105, 4),
    -_normalization(21, 32),
    _normalization(7, 16),
    -_normalization(21, 32),
    _normalization(105, 4) / 2,
    -_normalization(35, 32),
)
"""Factors of the harmonics of degree 1, 2 and 3, in order."""
_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


def sh_basis(directions: Float[np.ndarray, "*n 3"], degree: int) -> Float[np.ndarray, "*n k"]:
    """Return real harmonics of degree 0 to ``degree`` (at most 3) at unit directions, signs as in 3DGS.

    >>> abs(sh_basis(np.array([[0.0, 0.0, 1.0]]), 1)).round(4).tolist()
    [[0.2821, 0.0, 0.4886, 0.0]]
    """
    x, y, z = np.moveaxis(directions, -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    c1, c2, c3 = SH_C1, SH_C2, SH_C3
    functions = [
        np.full_like(x, SH_C0),
        -c1 * y, c1 * z, -c1 * x,
        c2[0] * x * y, c2[1] * y * z, c2[2] * (2 * zz - xx - yy), c2[3] * x * z, c2[4] * (xx - yy),
        c3[0] * y * (3 * xx - yy), c3[1] * x * y * z, c3[2] * y * (4 * zz - xx - yy),
        c3[3] * z * (2 * zz - 3 * xx - 3 * yy),
        c3[4] * x * (4 * zz - xx - yy), c3[5] * z * (xx - yy), c3[6] * x * (xx - 3 * yy),
    ]  # fmt: skip
    return np.stack(functions[: (degree + 1) ** 2], axis=-1)


def sh_basis_gradients(directions: Float[np.ndarray, "*n 3"], degree: int) -> Float[np.ndarray, "*n k 3"]:
    """Return derivatives of :func:`sh_basis`'s polynomials by x, y and z, at unit directions.

    They are those of a function in space: on the sphere, only what is tangential to it counts.
    """
    x, y, z = np.moveaxis(directions, -1, 0)
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    none, one = np.zeros_like(x), np.ones_like(x)
    rows = [
        (SH_C0, (none, none, none)),
        (-SH_C1, (none, one, none)), (SH_C1, (none, none, one)), (-SH_C1, (one, none, none)),
        (SH_C2[0], (y, x, none)), (SH_C2[1], (none, z, y)), (SH_C2[2], (-2 * x, -2 * y, 4 * z)),
        (SH_C2[3], (z, none, x)), (SH_C2[4], (2 * x, -2 * y, none)),
        (SH_C3[0], (6 * xy, 3 * (xx - yy), none)), (SH_C3[1], (yz, xz, xy)),
        (SH_C3[2], (-2 * xy, 4 * zz - xx - 3 * yy, 8 * yz)),
        (SH_C3[3], (-6 * xz, -6 * yz, 6 * zz - 3 * (xx + yy))),
        (SH_C3[4], (4 * zz - 3 * xx - yy, -2 * xy, 8 * xz)), (SH_C3[5], (2 * xz, -2 * yz, xx - yy)),
        (SH_C3[6], (3 * (xx - yy), -6 * xy, none)),
    ]  # fmt: skip
    slopes = [factor * np.stack(parts, axis=-1) for factor, parts in rows[: (degree + 1) ** 2]]
    return np.stack(slopes, axis=-2)


def rotate_sh(
    sh: Float32[np.ndarray, "n k 3"], rotations: Float[np.ndarray, "n 3 3"]
) -> Float32[np.ndarray, "n k 3"]:
    """Return coefficients after each Gaussian was rotated: new(d) = old(O^T d).

    Args:
        sh: coefficients of degree 0 to 3, coefficient-major.
        rotations: orthogonal matrices O, world to world; reflections are allowed.
    """
    degree = int(np.sqrt(sh.shape[1])) - 1
    turned = sh.copy()
    if degree == 0:
        return turned
    for start in range(0, len(sh), ROWS_PER_BATCH):
        part = slice(start, start + ROWS_PER_BATCH)
        matrices = sh_rotation_matrices(rotations[part], degree)
        for band, matrix in enumerate(matrices, start=1):
            own = slice(band**2, (band + 1) ** 2)
            turned[part, own] = np.einsum("nij,njc->nic", matrix, sh[part, own])
    return turned


def sh_rotation_matrices(
    rotations: Float[np.ndarray, "n 3 3"], degree: int
) -> list[Float[np.ndarray, "n m m"]]:
    """Return orthogonal matrices that rotate the coefficients of degree 1 to ``degree``."""
    samples, inverses = _sample_directions()
    values = sh_basis(np.einsum("nij,si->nsj", rotations.astype(np.float64), samples), degree)  # at O^T d
    return [
        np.einsum("ms,nsk->nmk", inverses[band], values[..., band**2 : (band + 1) ** 2])
        for band in range(1, degree + 1)
    ]


def fibonacci_sphere(count: int) -> Float[np.ndarray, "s 3"]:
    """Return unit directions spread evenly over the sphere (Fibonacci spiral).

    >>> directions = fibonacci_sphere(100)
    >>> bool(np.allclose(np.linalg.norm(directions, axis=1), 1.0))
    True
    >>> bool((abs(directions.mean(axis=0)) < 0.05).all())
    True
    """
    z = 1 - 2 * (np.arange(count) + 0.5) / count
    angle = _GOLDEN_ANGLE * np.arange(count)
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=-1)


@cache
def _sample_directions() -> tuple[Float[np.ndarray, "s 3"], dict[int, Float[np.ndarray, "m s"]]]:
    """Return directions over the sphere, and for each degree the map from values there to coefficients."""
    directions = fibonacci_sphere(SAMPLE_DIRECTIONS)
    basis = sh_basis(directions, 3)
    return directions, {band: np.linalg.pinv(basis[:, band**2 : (band + 1) ** 2]) for band in (1, 2, 3)}
