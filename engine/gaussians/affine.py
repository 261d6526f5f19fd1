"""Affine transforms of whole scenes, in closed form."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.gaussians.apply_legs import apply_legs
from octasplat.engine.gaussians.legs import legs_world
from octasplat.engine.gaussians.model import FlatGaussians

AXES: dict[str, Float64[np.ndarray, "3"]] = {
    sign + name: (1.0 if not sign else -1.0) * np.eye(3)[k]
    for k, name in enumerate("xyz")
    for sign in ("", "-")
}


def transform_gaussians(gaussians: FlatGaussians, matrix: Float[np.ndarray, "4 4"]) -> FlatGaussians:
    """Return the scene under the affine map x -> M x + t, its harmonics rotated, and mirrored if M mirrors.

    Covariances are exact for any invertible M. A map without rotation and scale leaves frames, scales and
    colors untouched.

    Raises:
        ConfigError: the matrix is not finite, not affine or flattens space.
    """
    m = np.asarray(matrix, dtype=np.float64)
    if not np.isfinite(m).all() or not np.array_equal(m[3], [0.0, 0.0, 0.0, 1.0]):
        raise ConfigError("The matrix must have finite numbers and the last row 0 0 0 1.")
    linear, shift = m[:3, :3], m[:3, 3]
    u, stretches, vt = np.linalg.svd(linear)
    if stretches[2] <= 1e-9 * stretches[0]:
        raise ConfigError("The matrix flattens space; each direction needs a scale other than 0.")
    # Orthogonal factor of the polar decomposition; a reflection where M mirrors
    turn = u @ vt
    count = len(gaussians)
    means = gaussians.means_world.astype(np.float64) @ linear.T + shift
    if np.array_equal(linear, np.eye(3)):
        moved = gaussians.copy()
        moved.means_world = means.astype(np.float32)
        return moved
    signs = np.full(count, np.sign(np.linalg.det(turn)))
    legs = linear @ legs_world(gaussians)
    return apply_legs(
        old=gaussians,
        means_world=means,
        legs=legs,
        normal_signs=signs,
        unmoved=np.zeros(count, dtype=bool),
        turn=turn,
    )


def mean_scale(matrix: Float[np.ndarray, "4 4"]) -> float:
    """Return the mean scale of an affine map: the cube root of its volume factor.

    >>> round(mean_scale(scaling(np.array([1.0, 2.0, 4.0]))), 6)
    2.0
    """
    return float(np.cbrt(abs(np.linalg.det(np.asarray(matrix, np.float64)[:3, :3]))))


def translation(offset_world: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "4 4"]:
    """Return the matrix of a translation.

    >>> translation(np.array([1.0, 2.0, 3.0])) @ [0.0, 0.0, 0.0, 1.0]
    array([1., 2., 3., 1.])
    """
    matrix = np.eye(4)
    matrix[:3, 3] = offset_world
    return matrix


def scaling(factors: Float[np.ndarray, "3"]) -> Float64[np.ndarray, "4 4"]:
    """Return the matrix of a scale along the world's axes."""
    return np.diag([*np.asarray(factors, np.float64), 1.0])


def rotation(axis_world: Float[np.ndarray, "3"], degrees: float) -> Float64[np.ndarray, "4 4"]:
    """Return the matrix of a rotation about an axis through the origin, counter-clockwise from its tip.

    >>> (rotation(np.array([0.0, 0.0, 1.0]), 90.0) @ [1.0, 0.0, 0.0, 1.0]).round(6).tolist()
    [0.0, 1.0, 0.0, 1.0]
    """
    axis = np.asarray(axis_world, np.float64)
    length = float(np.linalg.norm(axis))
    if not np.isfinite(length) or length == 0.0:
        raise ConfigError("The axis of a rotation must not be zero.")
    x, y, z = axis / length
    # Whole quarter turns come out without rounding.
    quarters, rest = divmod(degrees, 90.0)
    angle = np.radians(rest)
    cos, sin = np.cos(angle), np.sin(angle)
    for _ in range(int(quarters) % 4):
        cos, sin = -sin, cos
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    # Rodrigues' formula
    matrix[:3, :3] += sin * cross + (1 - cos) * (cross @ cross)
    return matrix


def between_axes(old_up: str, new_up: str) -> Float64[np.ndarray, "4 4"]:
    """Return the shortest rotation that brings one axis (``x``, ``-x``, ... ``-z``) to another.

    >>> (between_axes("-y", "z") @ [0.0, -1.0, 0.0, 1.0]).round(6).tolist()
    [0.0, 0.0, 1.0, 1.0]
    """
    old, new = AXES[old_up], AXES[new_up]
    if np.array_equal(old, new):
        return np.eye(4)
    if np.array_equal(old, -new):
        return rotation(AXES["x" if old[0] == 0 else "y"], 180.0)
    return rotation(np.cross(old, new), 90.0)


def conjugate_by_point(
    matrix: Float[np.ndarray, "4 4"], point_world: Float[np.ndarray, "3"]
) -> Float64[np.ndarray, "4 4"]:
    """Return the same map with ``point_world`` in the place of the origin.

    >>> point = np.array([1.0, 1.0, 0.0])
    >>> turn = conjugate_by_point(rotation(np.array([0.0, 0.0, 1.0]), 90.0), point)
    >>> (turn @ [*point, 1.0]).round(6).tolist()
    [1.0, 1.0, 0.0, 1.0]
    """
    result: np.ndarray = translation(point_world) @ matrix @ translation(-np.asarray(point_world))
    return result


def read_matrix(path: Path) -> Float64[np.ndarray, "4 4"]:
    """Read a 4 x 4 or 3 x 4 matrix from a text file, row by row; commas and brackets are ignored.

    Raises:
        ConfigError: the file cannot be read or holds something else.
    """
    try:
        words = path.read_text(encoding="utf-8").translate(str.maketrans(",;[]", "    ")).split()
        values = np.array([float(word) for word in words])
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise ConfigError(f"{path}: holds no matrix ({error}).") from error
    if len(values) not in (12, 16):
        raise ConfigError(f"{path}: holds {len(values)} numbers; a matrix has 12 or 16, row by row.")
    return whole_matrix(values.reshape(-1, 4))


def whole_matrix(rows: Float[np.ndarray, "r 4"]) -> Float64[np.ndarray, "4 4"]:
    """Return the 4 x 4 matrix of three or four rows.

    >>> bool((whole_matrix(np.eye(4)[:3]) == np.eye(4)).all())
    True
    """
    matrix = np.eye(4)
    matrix[: len(rows)] = rows
    return matrix
