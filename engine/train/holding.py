"""Holds surfaces to the sparse points: along their normals, a little at a time.

What a mirror shows has the parallax of things behind it. Wherever a reflection is painted on the surface
instead of reflected by it, photographs pull the surface down towards these virtual images, a hundredth of the
extent over a long training. Points that were matched over many photographs lie on the surface.
"""

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from engine.gaussians.model import FlatGaussians

AROUND = 16
"""Gaussians whose mean normal is that of a point."""
HOLDERS = 4
"""Points that hold a Gaussian."""
WITHIN = 3.0
"""A point holds Gaussians as far away as so many times its distance to other points."""
ALIKE = 0.7
"""Cosine between the normal at a point and that of a Gaussian from which on both belong to one surface."""
LEAST_OPACITY = 0.1
"""Gaussians thinner than this are no surface."""


class Held:
    """Points that surfaces are held to.

    Args:
        points_world: of the sparse model.
    """

    def __init__(self, points_world: Float64[np.ndarray, "p 3"]) -> None:
        self._points = points_world[np.isfinite(points_world).all(axis=1)].astype(np.float64)
        self._tree = cKDTree(self._points)
        distances = self._tree.query(self._points, min(4, len(self._points)))[0]
        self._reach = WITHIN * distances.reshape(len(self._points), -1)[:, 1:].mean(axis=1)

    def hold(self, gaussians: FlatGaussians, share: float) -> None:
        """Move Gaussians, in place, towards the points beside them by a share of their distance.

        The distance of a point to a surface through a Gaussian is taken along the mean of both normals, which
        is right for planes and spheres; the normal at a point is the mean of those of the Gaussians around.

        Args:
            gaussians: whose normals point to the same side of a surface.
            share: of the distance, from 0 to 1.
        """
        opacities = gaussians.opacities
        ids = np.flatnonzero(opacities > LEAST_OPACITY)
        if len(ids) < AROUND:
            return
        means = gaussians.means_world[ids].astype(np.float64)
        normals = gaussians.rotations[ids, :, 0].astype(np.float64)
        point_normals = self._normals(means, normals, opacities[ids])
        distances, near = self._tree.query(means, HOLDERS)
        away = self._points[near] - means[:, None]
        both = normals[:, None] + point_normals[near]
        weights = np.maximum(1 - (distances / self._reach[near]) ** 2, 0.0) ** 2
        weights *= (normals[:, None] * point_normals[near]).sum(axis=2) > ALIKE
        off = 0.5 * (both * away).sum(axis=2)
        moved = share * (weights * off).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-12)
        gaussians.means_world[ids] = (means + moved[:, None] * normals).astype(np.float32)

    def _normals(
        self, means: Float64[np.ndarray, "n 3"], normals: Float64[np.ndarray, "n 3"], opacities: np.ndarray
    ) -> Float64[np.ndarray, "p 3"]:
        """Those at the points; the nearest Gaussian says which of two surfaces that meet a point is on."""
        near = cKDTree(means).query(self._points, AROUND)[1]
        alike = (normals[near] * normals[near[:, :1]]).sum(axis=2) > ALIKE
        return _unit(((opacities[near] * alike)[..., None] * normals[near]).sum(axis=1))


def _unit(vectors: Float64[np.ndarray, "p 3"]) -> Float64[np.ndarray, "p 3"]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
