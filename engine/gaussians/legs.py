"""Legs, the scaled in-plane axes of a flat Gaussian, under deformations.

The *legs* of a Gaussian are the columns s2 r2 and s3 r3, so that its covariance is legs legs^T. A deformation
whose derivative is F takes them to F legs, which in general are neither orthogonal nor of the old length.
"""

import numpy as np
from jaxtyping import Float, Float64

from octasplat.engine.gaussians.frames import quaternions_from_matrices, rotation_matrices
from octasplat.engine.gaussians.model import FlatGaussians

MIN_LEG_RATIO = 1e-12
"""Legs whose smaller extent is less than this share of the larger one count as having no area."""


def legs_world(gaussians: FlatGaussians) -> Float64[np.ndarray, "n 3 2"]:
    """Return the legs s2 r2 and s3 r3 as columns, world frame."""
    rotations = rotation_matrices(gaussians.quats_wxyz.astype(np.float64))
    result: np.ndarray = rotations[:, :, 1:] * np.exp(gaussians.log_scales.astype(np.float64))[:, None, :]
    return result


def frames_from_skewed_legs(
    legs: Float64[np.ndarray, "n 3 2"], normal_signs: Float64[np.ndarray, " n"]
) -> tuple[Float64[np.ndarray, "n 4"], Float64[np.ndarray, "n 2"]]:
    """Return quaternions and log scales of the covariance legs legs^T, by singular value decomposition.

    One Jacobi rotation by at most 45 degrees makes the two columns orthogonal, which is exact for two columns
    and moves the axes as little as possible, so that an animation shows no jumps of the frame.

    Args:
        legs: with an area; where there is none the result is finite but meaningless.
        normal_signs: -1 where the normal is to be -leg2 x leg3 instead of leg2 x leg3.
    """
    a, b = legs[:, :, 0], legs[:, :, 1]
    aa, bb, ab = np.sum(a * a, axis=-1), np.sum(b * b, axis=-1), np.sum(a * b, axis=-1)
    angles = 0.5 * np.arctan2(2 * ab, aa - bb)  # tan(2 angle) = 2 a.b / (a.a - b.b)
    # atan2 makes the first axis the longer one; a quarter turn back keeps the axes in their order.
    angles -= np.where(angles > np.pi / 4, np.pi / 2, 0) - np.where(angles < -np.pi / 4, np.pi / 2, 0)
    cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
    first, second = cos * a + sin * b, cos * b - sin * a
    lengths = np.stack([np.linalg.norm(first, axis=-1), np.linalg.norm(second, axis=-1)], axis=-1)
    smallest = np.finfo(np.float64).tiny
    lengths = np.maximum(lengths, smallest)
    # The longer axis is known better; the other one is made exactly orthogonal to it.
    longer_first = lengths[:, :1] >= lengths[:, 1:]
    long = np.where(longer_first, first / lengths[:, :1], second / lengths[:, 1:])
    short = np.where(longer_first, second / lengths[:, 1:], first / lengths[:, :1])
    short = short - np.sum(short * long, axis=-1, keepdims=True) * long
    short /= np.maximum(np.linalg.norm(short, axis=-1, keepdims=True), smallest)
    r2, r3 = np.where(longer_first, long, short), np.where(longer_first, short, long)
    normals = np.cross(r2, r3)
    turned_over = normal_signs[:, None] < 0
    r3 = np.where(turned_over, -r3, r3)  # the sign of an in-plane axis means nothing to a Gaussian
    normals = np.where(turned_over, -normals, normals)
    return quaternions_from_matrices(np.stack([normals, r2, r3], axis=-1)), np.log(lengths)


def surface_rotations(
    gaussians: FlatGaussians, new_legs: Float64[np.ndarray, "n 3 2"], normal_signs: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 3 3"]:
    """Return orthogonal matrices O by which each Gaussian's surface was rotated, stretch and shear aside.

    The polar factor of the derivative within the surface, completed by the normal. Where ``normal_signs`` is
    -1 the normal lies on the other side of the surface, and O is a reflection.
    """
    old = rotation_matrices(gaussians.quats_wxyz.astype(np.float64))
    tangents = surface_derivatives(gaussians, new_legs)
    polar = _polar_factors(tangents)
    normals = np.cross(polar[:, :, 0], polar[:, :, 1]) * normal_signs[:, None]
    new = np.concatenate([normals[:, :, None], polar], axis=2)
    result: np.ndarray = new @ old.transpose(0, 2, 1)
    return result


def surface_derivatives(
    gaussians: FlatGaussians, new_legs: Float64[np.ndarray, "n 3 2"]
) -> Float64[np.ndarray, "n 3 2"]:
    """Return the images of the unit axes r2 and r3."""
    result: np.ndarray = new_legs * np.exp(-gaussians.log_scales.astype(np.float64))[:, None, :]
    return result


def volume_derivatives(
    gaussians: FlatGaussians, new_legs: Float64[np.ndarray, "n 3 2"], normal_signs: Float64[np.ndarray, " n"]
) -> Float64[np.ndarray, "n 3 3"]:
    """Return derivatives in space, world to world: the surface's, and its mean stretch along the normal.

    A surface says nothing of what happens beside it; this choice is exact where the map is a rotation with a
    uniform scale.
    """
    old = rotation_matrices(gaussians.quats_wxyz.astype(np.float64))
    tangents = surface_derivatives(gaussians, new_legs)
    product = np.cross(tangents[:, :, 0], tangents[:, :, 1])
    area = np.linalg.norm(product, axis=-1, keepdims=True)
    # Of length sqrt(area), the mean stretch of the surface
    normals = product / np.sqrt(np.maximum(area, np.finfo(np.float64).tiny)) * normal_signs[:, None]
    result: np.ndarray = np.concatenate([normals[:, :, None], tangents], axis=2) @ old.transpose(0, 2, 1)
    return result


def has_area(legs: Float[np.ndarray, "n 3 2"], rounding: Float[np.ndarray, " n"]) -> np.ndarray:
    """Return whether legs are finite and span more area than rounding (a length, world) explains."""
    finite = np.isfinite(legs).all(axis=(1, 2)) & np.isfinite(rounding)
    safe = np.where(finite[:, None, None], legs, 0.0).astype(np.float64)
    area = np.linalg.norm(np.cross(safe[:, :, 0], safe[:, :, 1]), axis=-1)
    longest = np.sqrt(np.sum(safe * safe, axis=(1, 2)))
    # area / longest is the smaller singular value up to a factor of sqrt(2)
    result: np.ndarray = finite & (area > longest * np.maximum(rounding, MIN_LEG_RATIO * longest))
    return result & (longest > 0)


def _polar_factors(tangents: Float64[np.ndarray, "n 3 2"]) -> Float64[np.ndarray, "n 3 2"]:
    """Return the nearest matrices with orthonormal columns, F (F^T F)^(-1/2), in closed form."""
    # Scaled to about 1, so that squares neither overflow nor vanish
    scale = np.maximum(np.abs(tangents).max(axis=(1, 2), keepdims=True), np.finfo(np.float64).tiny)
    f = tangents / scale
    gram = f.transpose(0, 2, 1) @ f
    root_det = np.linalg.norm(np.cross(f[:, :, 0], f[:, :, 1]), axis=-1)
    trace = gram[:, 0, 0] + gram[:, 1, 1]
    # Square root of the 2 x 2 matrix G: (G + sqrt(det G) I) / sqrt(tr G + 2 sqrt(det G))
    root = (gram + root_det[:, None, None] * np.eye(2)) / np.sqrt(trace + 2 * root_det)[:, None, None]
    # The determinant of the root is root_det.
    inverse = (
        np.stack(
            [
                np.stack([root[:, 1, 1], -root[:, 0, 1]], axis=-1),
                np.stack([-root[:, 1, 0], root[:, 0, 0]], axis=-1),
            ],
            axis=1,
        )
        / np.maximum(root_det, np.finfo(np.float64).tiny)[:, None, None]
    )
    q = f @ inverse
    # Gram-Schmidt, against what rounding left of scale and shear
    first = q[:, :, 0] / np.maximum(np.linalg.norm(q[:, :, 0], axis=-1, keepdims=True), 1e-300)
    second = q[:, :, 1] - np.sum(q[:, :, 1] * first, axis=-1, keepdims=True) * first
    second /= np.maximum(np.linalg.norm(second, axis=-1, keepdims=True), 1e-300)
    return np.stack([first, second], axis=-1)
