"""Motion of neighbouring Gaussians: to judge flipped octagons, and to move those without corners."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from scipy.spatial import KDTree

from octasplat.engine.core.threads import threads_in_use
from octasplat.engine.gaussians.apply_legs import row_blocks

NEIGHBOURS = 12
MIN_AGREEMENT = 0.8
"""Correlation of the neighbours' moves with a rotation and scale, below which they are no witnesses."""
MIRROR_GAIN = 0.1
"""A reflection must beat the best rotation by this much correlation to be believed: in a plane it cannot."""
STRAY_RATIO = 0.75
"""Of the spread of its neighbours: a Gaussian further from where they expect it has no witnesses in them."""
FLIPPED_COSINE = -0.2


@dataclass(frozen=True)
class CarriedGaussians:
    """Gaussians moved as their neighbours were.

    Attributes:
        means_world: new centres.
        derivatives: of the map at the centres, world to world.
        unmoved: every neighbour stayed as it was, so this one does too.
        orphaned: the nearest neighbour was deleted.
    """

    means_world: Float64[np.ndarray, "u 3"]
    derivatives: Float64[np.ndarray, "u 3 3"]
    unmoved: Bool[np.ndarray, " u"]
    orphaned: Bool[np.ndarray, " u"]


def neighbour_rotations(
    old_means: Float64[np.ndarray, "n 3"],
    new_means: Float64[np.ndarray, "n 3"],
    requested: Int64[np.ndarray, " m"],
) -> Float64[np.ndarray, "m 3 3"]:
    """Return the orthogonal matrices that best map each Gaussian's old neighbours to the new ones (Kabsch).

    Zero where there are too few neighbours, where they moved in no common way, or where the Gaussian itself
    went another way, as at the rim of a part that was moved. Neighbours that lie in a
    plane do not show whether they were mirrored; for them the whole scene decides.
    """
    count = min(NEIGHBOURS, len(old_means))
    if count < 4 or len(requested) == 0:
        return np.zeros((len(requested), 3, 3))
    tree = KDTree(old_means)
    everything = _orthogonal_fits(old_means[None], new_means[None], 1.0)
    planar_sign = -1.0 if _is_reflection(everything)[0] else 1.0
    turns = np.empty((len(requested), 3, 3))
    for block in row_blocks(len(requested)):
        _, near = tree.query(old_means[requested[block]], k=count, workers=threads_in_use())
        turns[block] = _orthogonal_fits(old_means[near], new_means[near], planar_sign)
        stray = _find_rim_gaussians(old_means[near], new_means[near], turns[block])
        turns[block][stray] = 0.0
    return turns


def _orthogonal_fits(
    old: Float64[np.ndarray, "m k 3"], new: Float64[np.ndarray, "m k 3"], planar_sign: float
) -> Float64[np.ndarray, "m 3 3"]:
    """Return rotations or reflections from old to new points; ``planar_sign`` decides for planar sets."""
    old = old - old.mean(axis=1, keepdims=True)
    new = new - new.mean(axis=1, keepdims=True)
    u, spread, vt = np.linalg.svd(np.einsum("nki,nkj->nij", new, old))
    best = np.sign(np.linalg.det(u @ vt))
    total = np.sqrt(np.sum(old**2, axis=(1, 2)) * np.sum(new**2, axis=(1, 2)))
    # Correlations of best rotation and best reflection differ by twice the least singular value.
    sign = np.where(2 * spread[:, 2] > MIRROR_GAIN * total, best, planar_sign)
    u[:, :, 2] *= (sign * best)[:, None]
    agreement = spread[:, 0] + spread[:, 1] + sign * best * spread[:, 2]
    turns: np.ndarray = u @ vt
    turns[agreement < MIN_AGREEMENT * total] = 0.0
    return turns


def _find_rim_gaussians(
    old: Float64[np.ndarray, "m k 3"], new: Float64[np.ndarray, "m k 3"], turns: Float64[np.ndarray, "m 3 3"]
) -> Bool[np.ndarray, " m"]:
    """Return Gaussians whose nearest neighbours moved differently: the rim of what was moved."""
    # The first neighbor of a Gaussian is itself.
    around_old, around_new = old[:, 1:].mean(axis=1), new[:, 1:].mean(axis=1)
    reach_old = np.sqrt(np.mean(np.sum((old[:, 1:] - around_old[:, None]) ** 2, axis=2), axis=1))
    reach_new = np.sqrt(np.mean(np.sum((new[:, 1:] - around_new[:, None]) ** 2, axis=2), axis=1))
    grown = reach_new / np.maximum(reach_old, 1e-300)
    expected = around_new + grown[:, None] * np.einsum("nij,nj->ni", turns, old[:, 0] - around_old)
    result: np.ndarray = np.linalg.norm(new[:, 0] - expected, axis=1) > STRAY_RATIO * reach_new
    return result


def _is_reflection(turns: Float64[np.ndarray, "m 3 3"]) -> Bool[np.ndarray, " m"]:
    result: np.ndarray = np.linalg.det(turns) < 0
    return result


def is_flipped(
    turns: Float64[np.ndarray, "m 3 3"],
    old_normals: Float64[np.ndarray, "m 3"],
    new_normals: Float64[np.ndarray, "m 3"],
) -> tuple[Bool[np.ndarray, " m"], Bool[np.ndarray, " m"]]:
    """Return which octagons face the other way than their neighbours; none where ``turns`` is zero.

    Returns:
        Which octagons flipped (alone), and which belong to a part of the scene that was mirrored as a whole,
        where the cross product of the legs points to the other side by right.
    """
    mirrored = _is_reflection(turns)
    expected = np.einsum("nij,nj->ni", turns, old_normals)
    cosines = np.sum(expected * new_normals, axis=-1)
    facing = np.where(mirrored, -cosines, cosines)
    return facing < FLIPPED_COSINE, mirrored


def interpolate_motion(
    points: Float64[np.ndarray, "u 3"],
    old_means: Float64[np.ndarray, "n 3"],
    new_means: Float64[np.ndarray, "n 3"],
    derivatives_of: Callable[[Int64[np.ndarray, " k"]], Float64[np.ndarray, "k 3 3"]],
    unmoved: Bool[np.ndarray, " n"],
    deleted_means: Float64[np.ndarray, "d 3"],
) -> CarriedGaussians:
    """Move points by the weighted affine maps of their nearest known Gaussians.

    Args:
        points: old centres of those without readable corners.
        old_means: old centres of those with.
        new_means: their new centres.
        derivatives_of: the derivatives of some of their maps.
        unmoved: which of them stayed exactly.
        deleted_means: old centres of Gaussians that were deleted.
    """
    count = min(NEIGHBOURS, len(old_means))
    if count == 0 or len(points) == 0:
        eye = np.broadcast_to(np.eye(3), (len(points), 3, 3)).copy()
        none = np.zeros(len(points), dtype=bool)
        return CarriedGaussians(points.copy(), eye, ~none, none)
    tree = KDTree(old_means)
    deleted_tree = KDTree(deleted_means) if len(deleted_means) else None
    carried = CarriedGaussians(
        np.empty((len(points), 3)),
        np.empty((len(points), 3, 3)),
        np.zeros(len(points), dtype=bool),
        np.zeros(len(points), dtype=bool),
    )
    for block in row_blocks(len(points)):
        part = points[block]
        distances, near = (
            found.reshape(len(part), count) for found in tree.query(part, k=count, workers=threads_in_use())
        )
        known, place = np.unique(near, return_inverse=True)
        derivatives = derivatives_of(known)[place.reshape(near.shape)]
        weights = _neighbor_weights(distances)
        moved = new_means[near] + np.einsum("nkij,nkj->nki", derivatives, part[:, None] - old_means[near])
        carried.means_world[block] = np.einsum("nk,nki->ni", weights, moved)
        carried.derivatives[block] = np.einsum("nk,nkij->nij", weights, derivatives)
        carried.unmoved[block] = unmoved[near].all(axis=1)
        if deleted_tree is not None:
            carried.orphaned[block] = deleted_tree.query(part, workers=threads_in_use())[0] < distances[:, 0]
    return carried


def _neighbor_weights(distances: Float[np.ndarray, "u k"]) -> Float[np.ndarray, "u k"]:
    """Return weights that fall to zero at the last neighbour, so that they are continuous."""
    reach = distances[:, -1:] * (1 + 1e-6) + 1e-30
    # The small term keeps the sum above 0 where all neighbors are equally far.
    weights = (1 - distances / reach) ** 2 + 1e-12
    result: np.ndarray = weights / weights.sum(axis=1, keepdims=True)
    return result
