"""Scenes under any deformation of space: octagon corners in, corners out, Gaussians recovered from them.

This is where a physics engine comes in: it needs to move points, nothing else.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from engine.edit.local_maps import has_area, legs_world
from engine.edit.octagon_fit import fit_octagons
from engine.edit.recovery import apply_legs
from engine.gaussians.model import FlatGaussians
from engine.gaussians.octagon import SIDES, corner_directions

CUBATURE_RADIUS = float(np.sqrt(2.0))
"""Eight corners at this radius have the mean and covariance of the Gaussian itself, so that the affine map
fitted to them is the best one under the Gaussian's own weight, up to third order."""

CornerMap = Callable[[Float64[np.ndarray, "n 8 3"]], Float[np.ndarray, "n 8 3"]]


@dataclass(frozen=True)
class DeformReport:
    """What a deformation did.

    Attributes:
        moved: Gaussians with new parameters.
        unmoved: Gaussians that keep every bit.
        collapsed: moved ones that lost their area; they were placed, with their old frame and size.
        residual_median: how far the deformation is from affine over one Gaussian: root mean square distance
            of its corners from the fit, in standard deviations; median of the moved ones.
        residual_p95: 95th percentile.
        residual_max: largest.
    """

    moved: int
    unmoved: int
    collapsed: int
    residual_median: float
    residual_p95: float
    residual_max: float


def deformation_corners(gaussians: FlatGaussians) -> Float64[np.ndarray, "n 8 3"]:
    """The points of each Gaussian that a deformation is asked about, world frame.

    An octagon of radius sqrt(2) standard deviations, whatever the opacity; its mean is the centre.
    """
    spokes = np.einsum("kc,nic->nki", CUBATURE_RADIUS * corner_directions(), legs_world(gaussians))
    result: np.ndarray = gaussians.means_world.astype(np.float64)[:, None] + spokes
    return result


def deform(gaussians: FlatGaussians, corner_map: CornerMap) -> tuple[FlatGaussians, DeformReport]:
    """The scene under ``corner_map``, any function that takes and returns points of shape (n, 8, 3).

    Points that it returns exactly as they were leave their Gaussian as it was, bit for bit.
    """
    corners = deformation_corners(gaussians)
    return deform_to(gaussians, corners, corner_map(corners))


def deform_to(
    gaussians: FlatGaussians,
    corners_world: Float64[np.ndarray, "n 8 3"],
    moved_world: Float[np.ndarray, "n 8 3"],
) -> tuple[FlatGaussians, DeformReport]:
    """The scene with its :func:`deformation_corners` moved from ``corners_world`` to ``moved_world``.

    Raises:
        ValueError: a moved point is not finite.
    """
    moves = moved_world.astype(np.float64) - corners_world
    if not np.isfinite(moves).all():
        raise ValueError("the deformation gave points that are not finite")
    count = len(gaussians)
    unmoved = ~moves.any(axis=(1, 2))
    everywhere = np.ones((count, SIDES), dtype=bool)
    fit = fit_octagons(gaussians, moves, everywhere, np.full(count, CUBATURE_RADIUS))
    rounding = 8 * np.finfo(np.float64).eps * np.abs(moved_world).max(axis=(1, 2)).astype(np.float64)
    collapsed = ~unmoved & ~has_area(fit.legs_world, rounding)
    legs = np.where(collapsed[:, None, None], 0.0, fit.legs_world)
    result = apply_legs(gaussians, fit.means_world, legs, np.ones(count), unmoved)
    residuals = fit.residuals[~unmoved & ~collapsed]
    median, p95 = np.quantile(residuals, [0.5, 0.95]).tolist() if len(residuals) else (0.0, 0.0)
    report = DeformReport(
        int((~unmoved).sum()),
        int(unmoved.sum()),
        int(collapsed.sum()),
        median,
        p95,
        float(residuals.max(initial=0.0)),
    )
    return result, report
