"""What meshes keep off and let through between lit points and lights."""

import numpy as np
from jaxtyping import Float32, Int64

from engine.light.arrays import ShadowRays
from engine.light.bsdf import fresnel
from engine.light.kernels_frosted import LEAST_FROST
from engine.light.staging import LitMeshes
from engine.rays import RayBatch

MOST_SURFACES = 16


def shadow_rays(shadows: ShadowRays, which: Int64[np.ndarray, " n"], t_min: float = 0.0) -> RayBatch:
    """Some of the shadow rays."""
    return RayBatch(
        shadows.origins_world[which], shadows.directions_world[which], t_min, shadows.t_max[which]
    )


def let_through(
    meshes: LitMeshes, shadows: ShadowRays, which: Int64[np.ndarray, " n"], *, through_frost: bool = False
) -> Float32[np.ndarray, "n 3"]:
    """The share of light that meshes let through on each ray, in each channel: 0 or 1, but for glass.

    Where a ray is marked so, light goes straight through glass, less what Fresnel, tint and Beer take. Paths
    find light that glass bends only where a lamp has an extent and the lit point sends paths on; everywhere
    else glass would cast the shadow of a stone. Rough glass sends paths on from its own surface, which find
    such light; only where none are sent (``through_frost``) does it let light through as if it were smooth.
    """
    share = np.ones((len(which), 3), np.float32)
    rays = shadow_rays(shadows, which)
    if meshes.obstacles is None or meshes.glass is None or meshes.glass_faces is None:
        share[meshes.triangles.occluded(rays)] = 0.0
        return share
    straight = shadows.straight[which]
    share[~straight & meshes.triangles.occluded(rays)] = 0.0
    share[straight & meshes.obstacles.occluded(rays)] = 0.0
    left = np.flatnonzero(straight & (share[:, 0] > 0))
    t_min = np.zeros(len(left), np.float32)
    for _ in range(MOST_SURFACES):
        part = rays[left]
        hits = meshes.glass.closest(RayBatch(part.origins_world, part.directions_world, t_min, part.t_max))
        met = hits.hit
        left, t_before, t = left[met], t_min[met], hits.distances[met]
        if len(left) == 0:
            break
        faces = meshes.glass_faces[hits.faces[met]]
        rows = meshes.surfaces.materials[faces]
        corners = meshes.surfaces.corners_world[faces].astype(np.float64)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        cosines = (normals * rays.directions_world[left]).sum(axis=1)
        kept = meshes.materials.colours_linear[rows].copy()
        if not through_frost:
            rough = meshes.materials.roughness[rows] >= LEAST_FROST
            kept[rough & (meshes.materials.iors[rows] != 1.0)] = 0.0
        for ior in np.unique(meshes.materials.iors[rows]):
            same = meshes.materials.iors[rows] == ior
            kept[same] *= 1.0 - fresnel(np.minimum(np.abs(cosines[same]), 1.0), float(ior))[0][:, None]
        # Out of the glass: what it absorbed on the way.
        lengths = np.where(cosines > 0, t - t_before, 0.0)
        kept *= np.exp(-meshes.materials.absorption[rows] * lengths[:, None])
        share[left] *= kept.astype(np.float32)
        t_min = t * np.float32(1 + 1e-6) + np.float32(1e-7)
    return share
