"""Scenes under any deformation of space, evaluated at octagon corners.

This is where a physics engine comes in: it needs to move points, nothing else.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Float64

from octasplat.engine.edit.octagon_fit import fit_octagons
from octasplat.engine.edit.reports import DeformReport
from octasplat.engine.gaussians.apply_legs import apply_legs_to, row_blocks
from octasplat.engine.gaussians.legs import has_area, legs_world
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import SIDES, corner_directions

CUBATURE_RADIUS = float(np.sqrt(2.0))
"""Eight corners at this radius have the mean and covariance of the Gaussian itself, so that the affine map
fitted to them is the best one under the Gaussian's own weight, up to third order."""

CornerMap = Callable[[Float64[np.ndarray, "n 8 3"]], Float[np.ndarray, "n 8 3"]]


def deformation_corners(gaussians: FlatGaussians) -> Float64[np.ndarray, "n 8 3"]:
    """Return the points of each Gaussian at which a deformation is evaluated, world frame.

    An octagon of radius sqrt(2) standard deviations, whatever the opacity; its mean is the centre.
    """
    corners = np.empty((len(gaussians), SIDES, 3))
    # Harmonics take most of the memory and are not needed here.
    geometry = gaussians.with_base_color_only()
    for block in row_blocks(len(gaussians)):
        part = geometry.select(block)
        spokes = np.einsum("kc,nic->nki", CUBATURE_RADIUS * corner_directions(), legs_world(part))
        corners[block] = part.means_world.astype(np.float64)[:, None] + spokes
    return corners


def deform(
    gaussians: FlatGaussians, corner_map: CornerMap, mirrored: bool = False
) -> tuple[FlatGaussians, DeformReport]:
    """Return the scene under ``corner_map``, any function of points of shape (n, 8, 3).

    Points that it returns exactly as they were leave their Gaussian as it was, bit for bit.

    Args:
        gaussians: the scene.
        corner_map: asked once, about all points.
        mirrored: whether the map mirrors space, which eight points of one plane cannot tell.

    Raises:
        ValueError: a moved point is not finite.
    """
    corners = deformation_corners(gaussians)
    return deform_to(gaussians, corners, corner_map(corners), mirrored)


def deform_to(
    gaussians: FlatGaussians,
    corners_world: Float64[np.ndarray, "n 8 3"],
    moved_world: Float[np.ndarray, "n 8 3"],
    mirrored: bool | Bool[np.ndarray, " n"] = False,
) -> tuple[FlatGaussians, DeformReport]:
    """Return the scene with its :func:`deformation_corners` moved from ``corners_world`` to ``moved_world``.

    Args:
        gaussians: the scene.
        corners_world: as :func:`deformation_corners` gave them.
        moved_world: where they are now.
        mirrored: whether space was mirrored, everywhere or around each Gaussian. There the view-dependent
            colors are mirrored, too, and the normals lie on the mirrored side.

    Raises:
        ValueError: a moved point is not finite.
    """
    count = len(gaussians)
    signs = np.where(np.broadcast_to(np.asarray(mirrored, dtype=bool), (count,)), -1.0, 1.0)
    means, legs = np.empty((count, 3)), np.empty((count, 3, 2))
    unmoved, collapsed = np.empty(count, dtype=bool), np.empty(count, dtype=bool)
    residuals = np.empty(count)
    geometry = gaussians.with_base_color_only()
    for block in row_blocks(count):
        moved = moved_world[block].astype(np.float64)
        moves = moved - corners_world[block]
        if not np.isfinite(moves).all():
            raise ValueError("the deformation gave points that are not finite")
        present, radii = np.ones(moves.shape[:2], dtype=bool), np.full(len(moves), CUBATURE_RADIUS)
        fit = fit_octagons(geometry.select(block), moves, present, radii)
        # What rounding alone may leave of an octagon that collapsed
        rounding = 8 * np.finfo(np.float64).eps * np.abs(moved).max(axis=(1, 2))
        unmoved[block] = ~moves.any(axis=(1, 2))
        collapsed[block] = ~unmoved[block] & ~has_area(fit.legs_world, rounding)
        means[block], residuals[block] = fit.means_world, fit.residuals
        legs[block] = np.where(collapsed[block, None, None], 0.0, fit.legs_world)
    result = gaussians.copy()
    apply_legs_to(result, np.flatnonzero(~unmoved), means, legs, signs)
    known = residuals[~unmoved & ~collapsed]
    median, p95 = np.quantile(known, [0.5, 0.95]).tolist() if len(known) else (0.0, 0.0)
    report = DeformReport(
        moved=int((~unmoved).sum()),
        unmoved=int(unmoved.sum()),
        collapsed=int(collapsed.sum()),
        mirrored=int((~unmoved & (signs < 0)).sum()),
        residual_median=median,
        residual_p95=p95,
        residual_max=float(known.max(initial=0.0)),
    )
    return result, report
