"""Free space around each camera, estimated from the sparse points.

There is free space where a camera was, and for some distance around it. A Gaussian there is seen from close
up by few photographs or by none, but is a floater in views from between the cameras.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from octasplat.engine.dataset.model import PosedView, SparsePoints, Viewpoints

MIN_POINTS = 50
"""Fewer points say nothing about what is near."""
NEAREST_QUANTILE = 10
"""Where so many points are as near, something stands there; fewer may be wrong matches."""


def camera_clearances(viewpoints: Viewpoints, points: SparsePoints) -> Float64[np.ndarray, " v"]:
    """Return the radius of free space around each camera in world units; 0 where there are too few points.

    It is the same in all directions, as other photographs show what is behind a camera. It comes from the
    nearest points, not from a share of all: a tree trunk before a house has few of all points.
    """
    if len(points) < MIN_POINTS:
        return np.zeros(len(viewpoints.views))
    from scipy.spatial import cKDTree  # here, as most who import this module ask for no radius

    origins = np.stack([view.origin_world for view in viewpoints.views])
    distances, _ = cKDTree(points.xyz_world.astype(np.float64)).query(origins, k=[NEAREST_QUANTILE])
    return np.asarray(distances[:, 0], np.float64)


@dataclass(frozen=True, eq=False)
class CameraClearance:
    """A ball around each camera.

    Attributes:
        views: the views.
        radii: of the balls, world units; 0 for none.
    """

    views: Sequence[PosedView]
    radii: Float64[np.ndarray, " v"]

    @classmethod
    def from_views(
        cls, viewpoints: Viewpoints, radii: Float64[np.ndarray, " v"], which: Int64[np.ndarray, " t"]
    ) -> "CameraClearance":
        """Return the free space around the views ``which``; ``radii`` has one row for each view."""
        return cls([viewpoints.views[i] for i in which.tolist()], radii[which])

    def scaled(self, times: float) -> "CameraClearance":
        """Return the same zones with their radii multiplied by ``times``."""
        return CameraClearance(self.views, self.radii * times)

    def contains(self, xyz_world: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return whether each point lies in any of the zones."""
        inside = np.zeros(len(xyz_world), np.bool_)
        around = np.flatnonzero(self.radii > 0)
        if len(xyz_world) == 0 or len(around) == 0:
            return inside
        from scipy.spatial import cKDTree

        # What is farther from every camera than the largest ball reaches is in none of them.
        origins = np.stack([self.views[i].origin_world for i in around.tolist()])
        reach = float(self.radii.max())
        rows = np.flatnonzero(cKDTree(origins).query(xyz_world, distance_upper_bound=reach)[0] < np.inf)
        near = xyz_world[rows].astype(np.float64)
        for origin, radius in zip(origins, self.radii[around].tolist(), strict=True):
            away = near - origin
            inside[rows[np.flatnonzero((away * away).sum(axis=1) < radius * radius)]] = True
        return inside
