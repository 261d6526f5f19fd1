"""Blended normals, flipped to face the viewer.

Where normals keep their side (``flip_normal_cos`` of :class:`octasplat.engine.trace.protocol.TraceSettings`),
the blend of a ray that grazes an outline may point a little away from the viewer. No surface that is seen
does so: it is laid back into the plane across the ray, but for :data:`MIN_VIEW_COSINE`.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64

MIN_VIEW_COSINE = 1e-3
"""Of a faced normal to the viewer."""


class FacedNormals(NamedTuple):
    """Blended normals of ``r`` rays, facing the viewer.

    Attributes:
        normal_world: unit vectors with a cosine of at least :data:`MIN_VIEW_COSINE` to the viewer.
        blended_world: unit vectors, as they were.
        length: of the blend.
        tangent_length: length of the blended unit vector once it is laid back; 1 where it faced the viewer.
        is_away: which did not.
    """

    normal_world: Float64[np.ndarray, "r 3"]
    blended_world: Float64[np.ndarray, "r 3"]
    length: Float64[np.ndarray, " r"]
    tangent_length: Float64[np.ndarray, " r"]
    is_away: Bool[np.ndarray, " r"]

    def backward(
        self, normal_gradient: Float64[np.ndarray, "r 3"], directions_world: Float[np.ndarray, "r 3"]
    ) -> Float64[np.ndarray, "r 3"]:
        """Return gradients by :func:`face_viewer`'s sums, from those by the unit normals."""
        grad_laid = (
            normal_gradient
            - (normal_gradient * self.normal_world).sum(axis=1, keepdims=True) * self.normal_world
        )
        grad_laid /= self.tangent_length[:, None]
        along = (grad_laid * directions_world).sum(axis=1, keepdims=True)
        grad_blended = grad_laid - np.where(self.is_away[:, None], along * directions_world, 0.0)
        grad_blended -= (grad_blended * self.blended_world).sum(axis=1, keepdims=True) * self.blended_world
        return np.asarray(grad_blended / self.length[:, None])


def face_viewer(
    normal_sums_world: Float[np.ndarray, "r 3"], directions_world: Float[np.ndarray, "r 3"]
) -> FacedNormals:
    """Return unit normals that face the viewer, from normals summed along rays of unit directions.

    A sum of nothing stays 0.
    """
    sums = normal_sums_world.astype(np.float64)
    length = np.maximum(np.linalg.norm(sums, axis=1), 1e-9)
    blended = sums / length[:, None]
    along = (blended * directions_world).sum(axis=1) + MIN_VIEW_COSINE
    away = (along > 0) & (length > 1e-9)  # a sum of nothing has no side
    laid = blended - np.where(away, along, 0.0)[:, None] * directions_world
    shortened = np.where(away, np.maximum(np.linalg.norm(laid, axis=1), 1e-9), 1.0)
    return FacedNormals(laid / shortened[:, None], blended, length, shortened, away)
