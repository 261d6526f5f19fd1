"""Holds surfaces to the sparse points: along their normals, a little at a time.

What a mirror shows has the parallax of things behind it. Wherever a reflection is painted on the surface
instead of reflected by it, photographs pull the surface down towards these virtual images, a hundredth of the
extent over a long training. Points that were matched in many photographs lie on the surface.
"""

import numpy as np
from jaxtyping import Float32, Float64
from scipy.spatial import cKDTree

from engine.gaussians.model import FlatGaussians

AROUND = 16
"""Gaussians whose mean normal is that of a point."""
HOLDERS = 4
"""Points that hold a Gaussian."""
WITHIN = 3.0
"""A point holds Gaussians as far away as so many times its distance to other points."""
ALIKE = 0.7
"""Cosine between two normals from which on both are of one surface."""
LEAST_OPACITY = 0.1
"""Gaussians thinner than this are no surface."""


class Held:
    """Points that surfaces are held to.

    Args:
        points_world: of the sparse model, more than three; what is not finite is left out.
    """

    def __init__(self, points_world: Float64[np.ndarray, "p 3"]) -> None:
        self._points = points_world[np.isfinite(points_world).all(axis=1)].astype(np.float64)
        self._tree = cKDTree(self._points)
        self._reach_world = WITHIN * self._tree.query(self._points, 4)[0][:, 1:].mean(axis=1)

    def hold(self, gaussians: FlatGaussians, share: float) -> None:
        """Move Gaussians, in place, along their normals towards the points beside them.

        How far a point lies off a Gaussian's surface is taken along the mean of the normals of both, which is
        right for planes and for spheres; the normal at a point is the mean of those of the Gaussians around.

        Args:
            gaussians: with normals that point to the same side of a surface.
            share: of that distance, from 0 to 1.
        """
        opacities = gaussians.opacities
        ids = np.flatnonzero(opacities > LEAST_OPACITY)
        if len(ids) < AROUND:
            return
        means = gaussians.means_world[ids].astype(np.float64)
        normals = gaussians.rotations[ids, :, 0].astype(np.float64)
        at_points = self._normals(means, normals, opacities[ids])
        distances, near = self._tree.query(means, HOLDERS)
        weights = np.maximum(1 - (distances / self._reach_world[near]) ** 2, 0.0) ** 2
        weights *= (normals[:, None] * at_points[near]).sum(axis=2) > ALIKE
        both = normals[:, None] + at_points[near]
        off = 0.5 * (both * (self._points[near] - means[:, None])).sum(axis=2)
        moved = share * (weights * off).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-12)
        gaussians.means_world[ids] = (means + moved[:, None] * normals).astype(np.float32)

    def _normals(
        self,
        means_world: Float64[np.ndarray, "n 3"],
        normals: Float64[np.ndarray, "n 3"],
        opacities: Float32[np.ndarray, " n"],
    ) -> Float64[np.ndarray, "p 3"]:
        """Those at the points; the nearest Gaussian says on which of two surfaces that meet a point lies."""
        near = cKDTree(means_world).query(self._points, AROUND)[1]
        alike = (normals[near] * normals[near[:, :1]]).sum(axis=2) > ALIKE
        found = ((opacities[near] * alike)[..., None] * normals[near]).sum(axis=1)
        return np.asarray(found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12))
