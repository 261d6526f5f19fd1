"""How near to each camera things can stand, as its photograph's sparse points show it.

What stands right in front of a lens would be seen by it; where the nearest points that a view shows are far
away, Gaussians close to it are clouds that only hide a wrong colour from that one view.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64
from scipy.spatial import cKDTree

from engine.scene.cameras import Camera
from engine.scene.model import PosedView, SparsePoints, Viewpoints
from engine.scene.seen import is_shown, least_cosine, points_in_cam

LEAST_POINTS = 50
"""Views that show fewer points say nothing about what is near."""
NEAREST = 10
"""Where so many points are as near, something stands there; fewer may be wrong matches."""
MOST_POINTS = 50_000
"""Of more points, evenly spaced ones are looked at."""


def nearest_depths(scene: Viewpoints, points: SparsePoints) -> Float64[np.ndarray, " v"]:
    """The depth at which what each view shows begins, world units; 0 where too few points say.

    Depths are along the axis of the camera. A point counts for each view whose picture it lies in, hidden or
    not: what hides it is nearer. A tree trunk before a house has few of all points, so that a share of them
    would pass it over.
    """
    step = max(1, -(-len(points) // MOST_POINTS))
    xyz = points.xyz_world[::step].astype(np.float64)
    rank = max(1, NEAREST // step) - 1
    found = np.zeros(len(scene.views))
    for k, view in enumerate(scene.views):
        in_cam = points_in_cam(xyz, view)
        depths = in_cam[is_shown(in_cam, scene.cameras[view.camera_index]), 2]
        if len(depths) >= LEAST_POINTS:
            found[k] = np.partition(depths, rank)[rank]
    return found


@dataclass(frozen=True, eq=False)
class NearZones:
    """The part of each view's pyramid that lies before a depth.

    Attributes:
        views: the views.
        cameras: their cameras.
        depths: where the zones end, along the axes of the cameras, world units; 0 for none.
    """

    views: Sequence[PosedView]
    cameras: Sequence[Camera]
    depths: Float64[np.ndarray, " v"]

    @classmethod
    def of(
        cls, scene: Viewpoints, depths: Float64[np.ndarray, " v"], which: Int64[np.ndarray, " t"]
    ) -> "NearZones":
        """The zones of the views ``which`` of a scene; ``depths`` are those of all its views."""
        return cls([scene.views[i] for i in which.tolist()], scene.cameras, depths[which])

    def holds(self, xyz_world: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether points lie in any of the zones."""
        inside = np.zeros(len(xyz_world), np.bool_)
        if len(xyz_world) == 0 or not (self.depths > 0).any():
            return inside
        origins = np.stack([view.origin_world for view in self.views])
        # Nothing is in a zone that is farther from every camera than the corners of the deepest zone.
        reach = max(
            depth / least_cosine(self.cameras[view.camera_index])
            for view, depth in zip(self.views, self.depths.tolist(), strict=True)
        )
        rows = np.flatnonzero(cKDTree(origins).query(xyz_world, distance_upper_bound=reach)[0] < np.inf)
        near = xyz_world[rows].astype(np.float64)
        for view, depth in zip(self.views, self.depths.tolist(), strict=True):
            if depth <= 0:
                continue
            in_cam = points_in_cam(near, view)
            close = np.flatnonzero((in_cam[:, 2] > 0) & (in_cam[:, 2] < depth))
            shown = is_shown(in_cam[close], self.cameras[view.camera_index])
            inside[rows[close[shown]]] = True
        return inside
