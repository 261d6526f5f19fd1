"""Material-aware normal propagation: what reflects well hands its normal on to its neighbours.

A smooth metal shows by its reflections which way it faces, to a fraction of a degree; a diffuse surface
hardly does. So each Gaussian turns to the mean of the normals around it, in which those of smooth metals
count most. New Gaussians, which begin with the normal of the one they come from, find theirs that way.

The idea is that of "Reflective Gaussian Splatting" (https://arxiv.org/abs/2412.19282), whose code does
something else: see :mod:`octasplat.engine.shading.ref_gaussian`.
"""

import numpy as np
from jaxtyping import Float64

from octasplat.engine.gaussians.frames import quaternions_from_matrices
from octasplat.engine.gaussians.materials import ALBEDO, METALLIC, ROUGHNESS
from octasplat.engine.gaussians.model import FlatGaussians

NEIGHBOURS = 12
MIN_COSINE = 0.9
"""Normals farther apart belong to two surfaces."""
MAX_PLANE_DISTANCE = 0.3
"""Distance from a Gaussian's plane, of that to its neighbours, from which on another surface is likely."""
MAX_COLOR_DIFFERENCE = 0.15
"""Difference of albedo or metallic from which on another thing is likely."""
MIN_TRUST = 0.1
"""Weight of a diffuse Gaussian's normal, where that of a perfect mirror is 1."""


def propagate_normals(gaussians: FlatGaussians) -> None:
    """Turn each Gaussian to the mean normal around it, in place; normals have no sign here.

    Neighbours count by opacity, nearness, likeness, and how well their material shows which way they face.
    """
    from scipy.spatial import cKDTree  # here, as every render imports this module

    means = gaussians.means_world.astype(np.float64)
    frames = gaussians.rotations.astype(np.float64)
    normals = frames[:, :, 0]
    distances, near = cKDTree(means).query(means, NEIGHBOURS + 1)
    # typical distance to the nearest neighbors
    spacing = np.maximum(distances[:, NEIGHBOURS // 2], 1e-12)[:, None]
    reflectivity = gaussians.channels[METALLIC][:, 0] * (1 - gaussians.channels[ROUGHNESS][:, 0])
    trust = gaussians.opacities * (MIN_TRUST + reflectivity)
    cosine = np.einsum("ni,nki->nk", normals, normals[near])
    plane_distance = np.einsum("ni,nki->nk", normals, means[near] - means[:, None]) / (
        MAX_PLANE_DISTANCE * spacing
    )
    appearance = (
        np.concatenate([gaussians.channels[ALBEDO], gaussians.channels[METALLIC]], axis=1)
        / MAX_COLOR_DIFFERENCE
    )
    unlike = ((appearance[near] - appearance[:, None]) ** 2).sum(axis=2)
    weights = trust[near] * np.exp(-0.5 * ((distances / spacing) ** 2 + plane_distance**2 + unlike))
    # sign: opposite normals are the same plane
    weights = np.where(np.abs(cosine) > MIN_COSINE, weights, 0.0) * np.sign(cosine)
    mean = np.einsum("nk,nki->ni", weights, normals[near])
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    mean = np.where(length > 0, mean / np.maximum(length, 1e-12), normals)
    rotated = np.einsum("nij,njk->nik", _rotations_between(normals, mean), frames)
    gaussians.quats_wxyz[:] = quaternions_from_matrices(rotated).astype(np.float32)


def _rotations_between(
    before: Float64[np.ndarray, "n 3"], after: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3 3"]:
    """Return the smallest rotations between pairs of unit vectors that are not opposite to each other."""
    axis = np.cross(before, after)
    cosine = (before * after).sum(axis=1)
    cross = np.zeros((len(before), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -axis[:, 2], axis[:, 1], -axis[:, 0]
    cross -= cross.transpose(0, 2, 1)
    # Rodrigues' formula without the angle
    return np.eye(3) + cross + (cross @ cross) / (1 + cosine)[:, None, None]
