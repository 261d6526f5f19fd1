"""Blended normals made to face the viewer.

Where normals keep their side (``turned_beyond`` of :class:`octasplat.engine.trace.protocol.TraceSettings`),
the blend of a ray that grazes an outline may point a little away from the viewer. No surface that is seen
does so: it is laid back into the plane across the ray, but for :data:`LEAST_COSINE`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

LEAST_COSINE = 1e-3
"""Of a faced normal to the viewer."""


class Faced(NamedTuple):
    """Blended normals of ``r`` rays, facing the viewer.

    Attributes:
        normal_world: unit vectors with a cosine of at least :data:`LEAST_COSINE` to the viewer.
        blended_world: unit vectors, as they were.
        length: of the blend.
        shortened: length of the blended unit vector once it is laid back; 1 where it faced the viewer.
        away: which did not.
    """

    normal_world: Float64[np.ndarray, "r 3"]
    blended_world: Float64[np.ndarray, "r 3"]
    length: Float64[np.ndarray, " r"]
    shortened: Float64[np.ndarray, " r"]
    away: Bool[np.ndarray, " r"]

    def slope(
        self, by_normal: Float64[np.ndarray, "r 3"], directions_world: Float[np.ndarray, "r 3"]
    ) -> Float64[np.ndarray, "r 3"]:
        """Gradients by the sums that were given to :func:`faced`, from those by the unit normals."""
        by_laid = by_normal - (by_normal * self.normal_world).sum(axis=1, keepdims=True) * self.normal_world
        by_laid /= self.shortened[:, None]
        along = (by_laid * directions_world).sum(axis=1, keepdims=True)
        by_blended = by_laid - np.where(self.away[:, None], along * directions_world, 0.0)
        by_blended -= (by_blended * self.blended_world).sum(axis=1, keepdims=True) * self.blended_world
        return np.asarray(by_blended / self.length[:, None])


def faced(sums_world: Float[np.ndarray, "r 3"], directions_world: Float[np.ndarray, "r 3"]) -> Faced:
    """Unit normals that face the viewer, from normals summed along rays with unit directions.

    A sum of nothing stays 0.
    """
    sums = sums_world.astype(np.float64)
    length = np.maximum(np.linalg.norm(sums, axis=1), 1e-9)
    blended = sums / length[:, None]
    along = (blended * directions_world).sum(axis=1) + LEAST_COSINE
    away = (along > 0) & (length > 1e-9)
    laid = blended - np.where(away, along, 0.0)[:, None] * directions_world
    shortened = np.where(away, np.maximum(np.linalg.norm(laid, axis=1), 1e-9), 1.0)
    return Faced(laid / shortened[:, None], blended, length, shortened, away)
