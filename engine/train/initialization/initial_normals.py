"""First normals of Gaussians on sparse points, by their neighbours and by the views that observe them."""

import numpy as np
from jaxtyping import Float64

from octasplat.engine.dataset import Dataset

PLANAR_RATIO = 0.1
"""Points lie on a plane where their least spread is below this share of the next, squared lengths."""
LINE_NEIGHBORS = 5
"""Points, the own one among them, that tell a thin part from a surface: more reach beyond it."""
LINEAR_RATIO = 0.03
"""They lie along a line where both lesser spreads are below this share of the largest, squared lengths."""


def mean_view_directions(dataset: Dataset) -> Float64[np.ndarray, "n 3"]:
    """Return for each sparse point the mean direction to the training views that observe it.

    Unit vectors; 0 for points of which no observation is known.
    """
    points, observations = dataset.points, dataset.observations
    sums = np.zeros((len(points), 3))
    if len(points) == 0 or len(observations) == 0:
        return sums
    row, is_there = points.rows_of(observations.point)
    known = is_there & np.isin(observations.view, dataset.train_indices)
    row, view = row[known], observations.view[known]
    centres = np.stack([v.origin_world for v in dataset.views])
    ways = centres[view] - points.xyz_world[row]
    np.add.at(sums, row, ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12))
    return sums / np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-12)


def plane_normals(
    neighborhoods: Float64[np.ndarray, "n k 3"], otherwise: Float64[np.ndarray, "n 3"]
) -> Float64[np.ndarray, "n 3"]:
    """Return the normals of the planes through points around each; ``otherwise`` where they lie on none."""
    centred = neighborhoods - neighborhoods.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
    # the least spread is small against the next: the points lie on a plane
    planar = values[:, 0] < PLANAR_RATIO * values[:, 1]
    return np.where(planar[:, None], vectors[:, :, 0], otherwise)


def seen_normals(
    neighborhoods: Float64[np.ndarray, "n k 3"],
    seen_from: Float64[np.ndarray, "n 3"],
    otherwise: Float64[np.ndarray, "n 3"],
) -> Float64[np.ndarray, "n 3"]:
    """Return first normals that face the views by which points are observed.

    On a surface they are those of its plane; along a thin part, where a plane is anyone's guess, they stand
    across it; elsewhere they look at the views.

    Args:
        neighborhoods: points around each, itself first and then from the nearest on.
        seen_from: mean directions to the views; 0 where not known.
        otherwise: taken for these.
    """
    seen = np.where((seen_from == 0).all(axis=1, keepdims=True), otherwise, seen_from)
    normals = plane_normals(neighborhoods, seen)
    close = neighborhoods[:, :LINE_NEIGHBORS]
    centred = close - close.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", centred, centred))
    linear = values[:, 1] < LINEAR_RATIO * values[:, 2]
    along = vectors[:, :, 2]
    across = seen - (seen * along).sum(axis=1, keepdims=True) * along
    length = np.linalg.norm(across, axis=1, keepdims=True)
    normals = np.where(linear[:, None] & (length > 1e-6), across / np.maximum(length, 1e-12), normals)
    return np.where((normals * seen).sum(axis=1, keepdims=True) < 0, -normals, normals)
