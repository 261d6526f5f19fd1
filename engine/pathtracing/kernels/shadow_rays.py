"""Shadow rays: occlusion and transmittance of meshes between shaded points and lights."""

import math

import numpy as np
from jaxtyping import Float32, Int32

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.kernel_args import MaterialArrays, MeshQueries, SurfaceArrays
from octasplat.engine.pathtracing.kernels.path_args import BLOCK_SIZE, PathScratch, ShadowRayArrays
from octasplat.engine.pathtracing.kernels.principled_bsdf import fresnel_dielectric
from octasplat.engine.pathtracing.kernels.rough_dielectric import MIN_GLASS_ROUGHNESS
from octasplat.engine.pathtracing.kernels.surface import face_normal
from octasplat.engine.trace.kernels.native import njit_no_refcount
from octasplat.engine.trace.kernels.triangles import (
    EmbreeQuery,
    TriangleHitArrays,
    TriangleRays,
    any_hits,
    closest_hits,
)

MAX_GLASS_SURFACES = 16
RESTART_SCALE = np.float32(1 + 1e-6)
RESTART_OFFSET = np.float32(1e-7)


@njit_no_refcount(forceinline=True)
def _select_shadow_rays(
    shadows: ShadowRayArrays, first: int, last: int, passes_glass: bool, rows: Int32[np.ndarray, " b"]
) -> int:
    """Return the rows of shadow rays that bring anything, the straight ones or the others, and how many."""
    count = 0
    for k in range(first, last):
        brings = (
            shadows.radiance_linear[k, 0] + shadows.radiance_linear[k, 1] + shadows.radiance_linear[k, 2]
            > 0.0
        )
        takes = (
            shadows.occluded_radiance_linear[k, 0]
            + shadows.occluded_radiance_linear[k, 1]
            + shadows.occluded_radiance_linear[k, 2]
            < 0.0
        )
        if (brings or takes) and shadows.passes_glass[k] == passes_glass:
            rows[count] = k
            count += 1
    return count


@njit_no_refcount(forceinline=True)
def _trace_occlusion(
    query: EmbreeQuery,
    shadows: ShadowRayArrays,
    scratch: PathScratch,
    count: int,
    transmittance: Float32[np.ndarray, "n 3"],
) -> int:
    """Set the light of occluded rows among the first ``count`` to zero."""
    scratch.t_starts[0] = 0.0  # one start for all rays
    rays = TriangleRays(
        shadows.origins_world, shadows.directions_world, scratch.t_starts[:1], shadows.t_max, scratch.rows
    )
    any_hits(query, rays, 0, count, scratch.embree, scratch.is_occluded)
    left = 0
    for i in range(count):
        k = scratch.rows[i]
        free = not scratch.is_occluded[i]
        transmittance[k, 0] = transmittance[k, 1] = transmittance[k, 2] = 1.0 if free else 0.0
        if free:
            scratch.rows[left] = k
            left += 1
    return left


@njit_no_refcount(forceinline=True)
def _trace_glass(
    queries: MeshQueries,
    surfaces: SurfaceArrays,
    materials: MaterialArrays,
    shadows: ShadowRayArrays,
    first: int,
    scratch: PathScratch,
    count: int,
    passes_rough_glass: bool,
    transmittance: Float32[np.ndarray, "n 3"],
) -> None:
    """Attenuate ``count`` rows on their way straight through glass, by Fresnel, tint and Beer's law."""
    for k in range(BLOCK_SIZE):
        scratch.t_starts[k] = 0.0
    # Starts are kept by the row's place in the block.
    rays = TriangleRays(
        shadows.origins_world[first:], shadows.directions_world[first:], scratch.t_starts,
        shadows.t_max[first:], scratch.rows,
    )  # fmt: skip
    met = TriangleHitArrays(scratch.distances, scratch.faces, scratch.barycentrics)
    for _ in range(MAX_GLASS_SURFACES):
        closest_hits(queries.closest_hit_glass, rays, 0, count, False, scratch.embree, met)
        left = 0
        for i in range(count):
            # rays that meet no more glass leave the list with what they have
            if scratch.faces[i] < 0:
                continue
            place = scratch.rows[i]
            k = first + place
            face = queries.glass_faces[scratch.faces[i]]
            m = surfaces.material_ids[face]
            n_x, n_y, n_z = face_normal(surfaces.corners_world[face])
            d = shadows.directions_world[k]
            cosine = n_x * d[0] + n_y * d[1] + n_z * d[2]
            reflectance, _ = fresnel_dielectric(min(abs(cosine), 1.0), materials.iors[m])
            reflectance = 1.0 - reflectance
            if (
                not passes_rough_glass
                and materials.roughness[m] >= MIN_GLASS_ROUGHNESS
                and materials.iors[m] != 1.0
            ):
                reflectance = 0.0  # rough glass passes light on by paths from its own surface
            t = scratch.distances[i]
            # Out of the glass: what it absorbed on the way.
            length = float(t - scratch.t_starts[place]) if cosine > 0.0 else 0.0
            for channel in range(3):
                passed = math.exp(-materials.absorption[m, channel] * length)
                transmittance[k, channel] *= reflectance * materials.colors_linear[m, channel] * passed
            # behind the surface, by more than the rounding of t
            scratch.t_starts[place] = t * RESTART_SCALE + RESTART_OFFSET
            scratch.rows[left] = place
            left += 1
        count = left
        if count == 0:
            break


@kernel(_nrt=False, error_model="numpy")
def shadow_transmittance(
    first: int,
    last: int,
    scratch: PathScratch,
    queries: MeshQueries,
    surfaces: SurfaceArrays,
    materials: MaterialArrays,
    shadows: ShadowRayArrays,
    passes_rough_glass: bool,
    transmittance: Float32[np.ndarray, "n 3"],
) -> None:
    """Write the share of light that meshes let through on each ray, in each channel: 0 or 1, but for glass.

    It is 0, too, for rays that bring nothing. Where a ray is marked so, light goes straight through glass,
    less what Fresnel, tint and Beer take. Paths find light that glass bends only where a lamp has an extent
    and the lit point sends paths on; everywhere else glass would cast the shadow of a stone. Rough glass
    sends paths on from its own surface, which find such light; only where none are sent
    (``passes_rough_glass``) does it let light through as if it were smooth.
    """
    for start in range(first, last, BLOCK_SIZE):
        end = min(start + BLOCK_SIZE, last)
        for k in range(start, end):
            transmittance[k, 0] = transmittance[k, 1] = transmittance[k, 2] = 0.0
        count = _select_shadow_rays(shadows, start, end, False, scratch.rows)
        _trace_occlusion(queries.any_hit, shadows, scratch, count, transmittance)
        count = _select_shadow_rays(shadows, start, end, True, scratch.rows)
        count = _trace_occlusion(queries.any_hit_opaque, shadows, scratch, count, transmittance)
        if queries.closest_hit_glass.scene != 0:
            for i in range(count):
                scratch.rows[i] -= start  # places in the block, by which the starts are kept
            _trace_glass(
                queries,
                surfaces,
                materials,
                shadows,
                start,
                scratch,
                count,
                passes_rough_glass,
                transmittance,
            )
