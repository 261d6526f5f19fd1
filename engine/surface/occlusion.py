"""Visibility of points past a mesh."""

import numpy as np
from jaxtyping import Bool, Float

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from octasplat.engine.trace.triangle_bvh import TriangleBvh

OFFSET_RATIO = 1e-3
"""The last thousandth of the way to a point is not tested, lest the point's own triangle hide it."""


class Occluder:
    """A mesh that hides what lies behind it."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self._scene = TriangleBvh(mesh.vertices_world, mesh.faces)

    def is_visible(
        self,
        points_world: Float[np.ndarray, "n 3"],
        viewers_world: Float[np.ndarray, "n 3"],
        tolerance: float = 0.0,
    ) -> Bool[np.ndarray, " n"]:
        """Return whether nothing lies between each point and its viewer.

        Args:
            points_world: the points, on the mesh or off it.
            viewers_world: where each is looked at from.
            tolerance: surface this near to the point (world units, along the ray) does not hide it.
        """
        way = points_world - viewers_world
        length = np.linalg.norm(way, axis=1)
        # a point may lie nearer than the tolerance
        reach = np.maximum(length * (1 - OFFSET_RATIO) - tolerance, 0.0)
        directions = way / np.maximum(length, 1e-30)[:, None]
        return ~self._scene.occluded(RayBatch(viewers_world, directions, t_max=reach))
