"""Affine maps fitted to the moved corners of octagons, by any corners that are left."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64

from octasplat.engine.gaussians.legs import legs_world
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import SIDES, corner_directions

MIN_CORNERS = 3
"""An affine map of a plane is fixed by three points; no three corners of an octagon lie on a line."""


@dataclass(frozen=True)
class OctagonFit:
    """The fitted map of each Gaussian.

    Attributes:
        means_world: new centres.
        legs_world: new legs, not orthogonal where the octagon was sheared.
        residuals: root mean square distance of the corners from the fit, in standard deviations along the
            longer new axis: how far the edit is from an affine map.
        is_folded: some triangle around the centre faces against the others.
    """

    means_world: Float64[np.ndarray, "n 3"]
    legs_world: Float64[np.ndarray, "n 3 2"]
    residuals: Float64[np.ndarray, " n"]
    is_folded: Bool[np.ndarray, " n"]


def fit_octagons(
    gaussians: FlatGaussians,
    moves_world: Float[np.ndarray, "n 8 3"],
    present: Bool[np.ndarray, "n 8"],
    radii: Float[np.ndarray, " n"],
) -> OctagonFit:
    """Return the least-squares affine map of each octagon's corners.

    Works on the moves of the corners, new minus old, so that the rounding of the old ones cancels and a
    corner that stayed says exactly that.

    Args:
        gaussians: as they were when the octagons were made.
        moves_world: new minus old position of each corner; not read where a corner is missing.
        present: which corners are there; rows with fewer than three keep their Gaussian as it was.
        radii: corner radii in standard deviations.
    """
    moves = np.where(present[:, :, None], moves_world, 0.0).astype(np.float64)
    old_legs = legs_world(gaussians)
    design = np.concatenate([np.ones((SIDES, 1)), corner_directions()], axis=1)
    fitted = np.zeros((len(moves), 3, 3))  # rows: shift of the centre, moves of the two legs times radius
    # The corners that are there as the bits of a byte: octagons with the same ones share a solution.
    codes = np.packbits(present, axis=1, bitorder="little")[:, 0]
    for code in np.unique(codes):
        corners = np.flatnonzero((int(code) >> np.arange(SIDES)) & 1)
        if len(corners) < MIN_CORNERS:
            continue
        rows = codes == code
        fitted[rows] = np.einsum("fk,nkc->nfc", np.linalg.pinv(design[corners]), moves[rows][:, corners])
    rest = np.where(present[:, :, None], moves - np.einsum("kf,nfc->nkc", design, fitted), 0.0)
    safe_radii = np.where(radii > 0, radii, 1.0).astype(np.float64)
    legs = old_legs + fitted[:, 1:].transpose(0, 2, 1) / safe_radii[:, None, None]
    means = gaussians.means_world.astype(np.float64) + fitted[:, 0]
    count = np.maximum(present.sum(axis=1), 1)
    rms = np.sqrt(np.sum(rest**2, axis=(1, 2)) / count)
    residuals = rms / np.maximum(largest_scale(legs), np.finfo(np.float32).tiny)
    # Relative to its centre, each corner as it is now: the affine part and what the fit leaves.
    spokes = np.einsum("kc,nic->nki", corner_directions(), legs) * safe_radii[:, None, None] + rest
    return OctagonFit(means, legs, residuals, _is_folded(spokes, legs, present))


def largest_scale(legs: Float64[np.ndarray, "n 3 2"]) -> Float64[np.ndarray, " n"]:
    """Return the larger singular value of each 3 x 2 matrix, whose columns are tangent vectors."""
    # Eigenvalues of the 2 x 2 Gram matrix are mean + spread and mean - spread.
    gram = legs.transpose(0, 2, 1) @ legs
    mean = (gram[:, 0, 0] + gram[:, 1, 1]) / 2
    spread = np.hypot((gram[:, 0, 0] - gram[:, 1, 1]) / 2, gram[:, 0, 1])
    result: np.ndarray = np.sqrt(mean + spread)
    return result


def _is_folded(
    spokes: Float64[np.ndarray, "n 8 3"],
    legs: Float64[np.ndarray, "n 3 2"],
    present: Bool[np.ndarray, "n 8"],
) -> Bool[np.ndarray, " n"]:
    normals = np.cross(legs[:, :, 0], legs[:, :, 1])
    following = np.roll(spokes, -1, axis=1)
    facing = np.einsum("nkc,nc->nk", np.cross(spokes, following), normals)
    both = present & np.roll(present, -1, axis=1)
    result: np.ndarray = (both & (facing < 0)).any(axis=1)
    return result
