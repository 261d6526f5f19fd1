"""The G-buffer: materials, normals and depths blended along rays before shading, with its backward pass."""

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from octasplat.engine.core.rays import AT_INFINITY, RayBatch
from octasplat.engine.shading.split_sum import SurfacePoints
from octasplat.engine.trace.facing_normals import FacedNormals, face_viewer
from octasplat.engine.trace.protocol import TraceResult

MIN_COSINE = 0.01
"""Cosine to the normal that reflected rays have at least."""
MIN_ALPHA = 0.02
"""Accumulated alpha up to which a ray is not shaded."""


class RayOffset(NamedTuple):
    """Offsets with which rays leave a surface of Gaussians.

    Attributes:
        bias_world: distance from it at which they begin.
        backface_cull_world: distance up to which they pass what they would meet from behind.
    """

    bias_world: float
    backface_cull_world: float = 0.0


@dataclass(frozen=True)
class GBuffer:
    """Depths, normals and materials blended along the rays that hit something.

    Attributes:
        ray_ids: numbers of these rays.
        alpha: accumulated alpha of each.
        depth: mean distance, lengths of the direction.
        facing_normals: the blended normals.
        surface: materials, normals and directions, not yet dimmed by anything.
    """

    ray_ids: Int64[np.ndarray, " p"]
    alpha: Float64[np.ndarray, " p"]
    depth: Float64[np.ndarray, " p"]
    facing_normals: FacedNormals
    surface: SurfacePoints

    def select(self, point_ids: Int64[np.ndarray, " w"]) -> "GBuffer":
        """Return the buffer of some of the points."""
        surface = {entry.name: getattr(self.surface, entry.name)[point_ids] for entry in fields(self.surface)}
        return GBuffer(
            self.ray_ids[point_ids],
            self.alpha[point_ids],
            self.depth[point_ids],
            FacedNormals(*(values[point_ids] for values in self.facing_normals)),
            SurfacePoints(**surface),
        )


def build_gbuffer(rays: RayBatch, result: TraceResult) -> GBuffer:
    """Return the G-buffer of a trace whose first features are materials."""
    alpha = 1.0 - result.transmittance.astype(np.float64)
    ray_ids = np.flatnonzero(alpha > MIN_ALPHA)
    alpha = alpha[ray_ids]
    directions = rays.directions_world[ray_ids]
    normals = face_viewer(result.normal_world[ray_ids], directions)
    surface = SurfacePoints.unoccluded(
        result.features[ray_ids, :5] / alpha[:, None], normals.normal_world, directions
    )
    return GBuffer(ray_ids, alpha, result.depth_sum[ray_ids] / alpha, normals, surface)


def backward_gbuffer(
    gbuffer: GBuffer,
    grad_material: Float64[np.ndarray, "p 5"],
    grad_unit_normal: Float64[np.ndarray, "p 3"],
    grad_features: Float64[np.ndarray, "r f"],
    grad_alpha: Float64[np.ndarray, " r"],
    grad_normal: Float64[np.ndarray, "r 3"],
) -> None:
    """Add gradients by a buffer's materials and unit normals to those by what was blended."""
    ray_ids, surface = gbuffer.ray_ids, gbuffer.surface
    grad_features[ray_ids, :5] += grad_material / gbuffer.alpha[:, None]
    # material = features / alpha, so that alpha has the opposite gradient
    grad_alpha[ray_ids] -= (grad_material * surface.material).sum(axis=1) / gbuffer.alpha
    grad_normal[ray_ids] += gbuffer.facing_normals.backward(grad_unit_normal, surface.direction_world)


def reflected_rays(
    rays: RayBatch,
    gbuffer: GBuffer,
    offset: RayOffset,
    facets_world: Float64[np.ndarray, "p 3"] | None = None,
) -> RayBatch:
    """Return rays from the points of a G-buffer along their reflected directions, begun off the surface.

    Args:
        rays: that the buffer was gathered along.
        gbuffer: of ``p`` points.
        offset: how far off, and how they get away from there.
        facets_world: unit normals to be mirrored at instead of the surface's; where that leads below the
            surface, the ray leaves along it.
    """
    ray_ids, normals = gbuffer.ray_ids, gbuffer.surface.normal_world
    origins = rays.origins_world if len(rays.origins_world) == 1 else rays.origins_world[ray_ids]
    directions = rays.directions_world[ray_ids].astype(np.float64)
    gap_world = offset.bias_world
    points = origins + gbuffer.depth[:, None] * directions + gap_world * normals
    facets = normals if facets_world is None else facets_world
    mirrored = directions - 2 * (directions * facets).sum(axis=1, keepdims=True) * facets  # d - 2 <d, n> n
    rise = (mirrored * normals).sum(axis=1, keepdims=True)
    # a facet may mirror below the surface: along it then
    mirrored += np.maximum(MIN_COSINE - rise, 0.0) * normals
    mirrored /= np.linalg.norm(mirrored, axis=1, keepdims=True)
    return RayBatch(
        points, mirrored, gap_world, t_view_origin=AT_INFINITY, t_backface_cull=offset.backface_cull_world
    )
