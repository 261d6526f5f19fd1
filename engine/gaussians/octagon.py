"""Octagons of flat Gaussians, their opacity-adapted radius, and the inverse conversion.

"The paper" is "REdiSplats: Ray Tracing for Editable Gaussian Splatting" (https://arxiv.org/abs/2503.12284).
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from octasplat.engine.gaussians.frames import quaternions_from_matrices
from octasplat.engine.gaussians.model import FlatGaussians

SIDES = 8
CHI2_3_99 = 11.344866730144373
"""Quantile 0.99 of the chi-square distribution with 3 degrees of freedom: the paper's Q."""
CHI2_2_99 = 9.210340371976184
"""Quantile 0.99 with 2 degrees of freedom, which a flat Gaussian really has: its rim lies at alpha = 0.01."""
APOTHEM = float(np.cos(np.pi / SIDES))
"""Inner radius of a regular octagon whose corners lie on the unit circle."""
FAN_TRIANGLES = np.array([[0, k, k + 1] for k in range(1, SIDES - 1)], dtype=np.int64)
"""The six triangles of one octagon, as corner numbers."""


def octagon_radii(opacities: Float[np.ndarray, " n"], q: float = CHI2_2_99) -> Float[np.ndarray, " n"]:
    """Return each octagon's corner radius in standard deviations, sqrt(max(0, Q - 2 ln(1/a))).

    At that radius alpha falls to exp(-Q/2), whatever the opacity a. A Gaussian fainter than that has
    radius 0 and no octagon.

    >>> octagon_radii(np.array([1.0, 0.5, 0.001])).round(3).tolist()
    [3.035, 2.797, 0.0]
    """
    with np.errstate(divide="ignore"):
        return np.sqrt(np.maximum(0.0, q + 2.0 * np.log(opacities.astype(np.float64)))).astype(
            opacities.dtype
        )


def cut_octagon_radii(
    opacities: Float[np.ndarray, " n"], q: float, alpha_cutoff: float | None
) -> Float[np.ndarray, " n"]:
    """Return :func:`octagon_radii`, no larger than it takes to show all that reaches an alpha.

    Args:
        opacities: of the Gaussians.
        q: chi-square quantile.
        alpha_cutoff: the octagon surrounds the ellipse in which alpha reaches that: its sides touch it, not
            its corners. None cuts nothing.

    >>> cut_octagon_radii(np.array([1.0, 0.5, 0.1]), CHI2_2_99, 0.2).round(3).tolist()
    [1.942, 1.465, 0.0]
    """
    radii = octagon_radii(opacities, q)
    if alpha_cutoff is None:
        return radii
    around = octagon_radii(opacities, -2.0 * math.log(alpha_cutoff)) / np.float32(APOTHEM)
    return np.minimum(radii, around)


def corner_directions() -> Float[np.ndarray, "8 2"]:
    """Return unit corner positions (cos, sin)(2 pi k / 8) in the (r2, r3) plane.

    >>> corner_directions()[[0, 2, 4]].round(6).tolist()
    [[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]]
    """
    angles = 2.0 * np.pi * np.arange(SIDES) / SIDES
    return np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def octagon_corners_world(
    gaussians: FlatGaussians, radii: Float[np.ndarray, " n"]
) -> Float32[np.ndarray, "n 8 3"]:
    """Return corners P_k = m + radius (s2 cos(2 pi k/8) r2 + s3 sin(2 pi k/8) r3), world frame (Eq. 6)."""
    rotations = gaussians.rotations.astype(np.float64)
    legs = rotations[:, :, 1:] * gaussians.scales.astype(np.float64)[:, None, :] * radii[:, None, None]
    corners = gaussians.means_world[:, None, :].astype(np.float64) + np.einsum(
        "kc,nic->nki", corner_directions(), legs
    )
    return corners.astype(np.float32)


def octagon_triangles(count: int) -> Int[np.ndarray, "m 3"]:
    """Return the fan triangles (0,1,2)...(0,6,7) of ``count`` octagons, in sequence.

    >>> octagon_triangles(1).tolist()
    [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5], [0, 5, 6], [0, 6, 7]]
    """
    return (np.arange(count)[:, None, None] * SIDES + FAN_TRIANGLES).reshape(-1, 3)


def frames_from_octagons(
    corners_world: Float[np.ndarray, "n 8 3"], radii: Float[np.ndarray, " n"]
) -> tuple[
    Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"], Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]
]:
    """Recover Gaussians (paper section 3.3): centre from corners 2 and 6, axes from corners 0 and 2.

    r2 and s2 come from corner 0, r3 by Gram-Schmidt from corner 2, r1 = r2 x r3. ``radii`` are those the
    octagons were made with. Shear is dropped: an octagon that an edit has sheared comes back orthogonal.

    Returns:
        Means (world), unit quaternions (wxyz), log scales, and a mask of the octagons that could be read. A
        crumpled one, whose area vanishes in the rounding of its corners, is False and has the identity
        rotation and log scales 0.
    """
    p = corners_world.astype(np.float64)
    radius = radii.astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        means = (p[:, 2] + p[:, 6]) / 2.0
        legs = np.stack([p[:, 0] - means, p[:, 2] - means], axis=1)
    rounding = coordinate_rounding_error(corners_world)
    quats, lengths, good = frames_from_semi_axes(legs, rounding)
    good &= radius > 0
    quats[~good] = (1.0, 0.0, 0.0, 0.0)
    log_scales = np.log(np.where(good[:, None], lengths / np.where(good, radius, 1.0)[:, None], 1.0))
    dtype = corners_world.dtype
    return means.astype(dtype), quats.astype(dtype), log_scales.astype(dtype), good


def coordinate_rounding_error(points_world: Float[np.ndarray, "n k 3"]) -> Float[np.ndarray, " n"]:
    """Return the length by which differences of a row's points may be off, as coordinates are rounded."""
    largest = np.abs(points_world.astype(np.float64)).max(axis=(1, 2))
    return 2.0 * float(np.finfo(points_world.dtype).eps) * largest


def frames_from_semi_axes(
    semi_axes_world: Float[np.ndarray, "n 2 3"], rounding: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "n 4"], Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Return quaternions and lengths of in-plane legs, the second made orthogonal (Gram-Schmidt).

    The mask is False, the rotation the identity and the lengths 1 where a leg is not finite or not longer
    than ``rounding``.
    """
    finite = np.isfinite(semi_axes_world).all(axis=(1, 2)) & np.isfinite(rounding)
    leg2, leg3 = np.where(finite[:, None, None], semi_axes_world, 0.0).transpose(1, 0, 2)
    length2 = np.linalg.norm(leg2, axis=-1)
    good = finite & (length2 > rounding)
    r2 = np.where(good[:, None], leg2, (1.0, 0.0, 0.0)) / np.where(good, length2, 1.0)[:, None]
    rest = leg3 - np.sum(leg3 * r2, axis=-1)[:, None] * r2
    length3 = np.linalg.norm(rest, axis=-1)
    # The first leg's rounding tilts r2, and a longer second leg magnifies the tilt.
    stretch = np.maximum(1.0, np.linalg.norm(leg3, axis=-1) / np.where(good, length2, 1.0))
    good &= length3 > rounding * stretch
    r3 = np.where(good[:, None], rest, 0.0) / np.where(good, length3, 1.0)[:, None]
    rotations = np.stack([np.cross(r2, r3), r2, r3], axis=-1)
    rotations[~good] = np.eye(3)
    lengths = np.where(good[:, None], np.stack([length2, length3], axis=-1), 1.0)
    return quaternions_from_matrices(rotations), lengths, good
