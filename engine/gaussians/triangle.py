"""The GaMeS triangle: a flat Gaussian as three points, its centre and the tips of its 1-sigma legs."""

import numpy as np
from jaxtyping import Bool, Float

from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import coordinate_rounding_error, frames_from_semi_axes


def triangles_world(gaussians: FlatGaussians) -> Float[np.ndarray, "n 3 3"]:
    """Vertices V1 = m, V2 = m + s r2, V3 = m + s' r3, the longer leg first (GaMeS)."""
    rotations = gaussians.rotations.astype(np.float64)
    legs = np.swapaxes(rotations[:, :, 1:] * gaussians.scales.astype(np.float64)[:, None, :], 1, 2)
    swap = gaussians.log_scales[:, 1] > gaussians.log_scales[:, 0]
    # (r1, r2, r3) -> (r1, r3, -r2) keeps the frame right-handed when the third axis is the longer one.
    swapped = np.stack([legs[:, 1], -legs[:, 0]], axis=1)
    legs = np.where(swap[:, None, None], swapped, legs)
    means = gaussians.means_world.astype(np.float64)[:, None, :]
    return np.concatenate([means, means + legs], axis=1)


def frames_from_triangles(
    vertices_world: Float[np.ndarray, "n 3 3"],
) -> tuple[
    Float[np.ndarray, "n 3"], Float[np.ndarray, "n 4"], Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]
]:
    """Means, unit quaternions (wxyz) and log scales of triangles; r3 by Gram-Schmidt, s3 = <V3 - V1, r3>.

    The last result is False for triangles without area, which get the identity rotation and log scales 0.
    """
    vertices = vertices_world.astype(np.float64)
    with np.errstate(invalid="ignore", over="ignore"):
        legs = vertices[:, 1:] - vertices[:, :1]
    quats, lengths, good = frames_from_semi_axes(legs, coordinate_rounding_error(vertices_world))
    dtype = vertices_world.dtype
    return vertices_world[:, 0].copy(), quats.astype(dtype), np.log(lengths).astype(dtype), good
