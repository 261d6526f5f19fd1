"""Shadow rays: occlusion and transmittance of meshes between shaded points and lights."""

import math

import numpy as np
from jaxtyping import Float32, Int32

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.cutouts import MAX_CUTOUTS, eval_opacity, restart_distance
from octasplat.engine.pathtracing.kernels.kernel_args import MaterialArrays, MeshQueries, SurfaceArrays
from octasplat.engine.pathtracing.kernels.nested_glass import (
    AIR,
    cross_surface,
    index_of,
    is_hidden,
    is_nested,
    medium_of,
)
from octasplat.engine.pathtracing.kernels.path_args import BLOCK_SIZE, PathScratch, ShadowRayArrays
from octasplat.engine.pathtracing.kernels.principled_bsdf import fresnel_dielectric
from octasplat.engine.pathtracing.kernels.rough_dielectric import MIN_GLASS_ROUGHNESS
from octasplat.engine.pathtracing.kernels.surface import (
    GLASS,
    eval_vertex_alpha,
    face_normal,
    interpolate_uv,
)
from octasplat.engine.trace.kernels.native import njit_no_refcount
from octasplat.engine.trace.kernels.triangles import (
    EmbreeQuery,
    TriangleHitArrays,
    TriangleRays,
    any_hits,
    closest_hits,
)


@njit_no_refcount(forceinline=True)
def _select_shadow_rays(
    shadows: ShadowRayArrays, first: int, last: int, passes_glass: bool, rows: Int32[np.ndarray, " b"]
) -> tuple[int, int]:
    """Write the rows of shadow rays that bring anything, the straight ones or those that pass glass.

    Returns how many they are, and how many are of the other sort.
    """
    count = others = 0
    for row in range(first, last):
        k = np.uintp(row)  # unsigned: no place is counted from the end of an array
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
        # no branch: which ray brings anything is not to be foreseen
        rows[np.uintp(count)] = row
        is_wanted = shadows.passes_glass[k] == passes_glass
        count += (brings | takes) & is_wanted
        others += (brings | takes) & (not is_wanted)
    return count, others


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
        transmittance[k, 0] = transmittance[k, 1] = transmittance[k, 2] = np.float32(free)
        scratch.rows[left] = k
        left += free
    return left


@njit_no_refcount(forceinline=True)
def _glass_share(roughness: float, eta: float, cosine: float, passes_rough_glass: bool) -> float:
    """Return the share of light that a surface of glass lets straight through."""
    # rough glass passes light on by paths from its own surface
    if not passes_rough_glass and roughness >= MIN_GLASS_ROUGHNESS and eta != 1.0:
        return 0.0
    reflectance, _ = fresnel_dielectric(min(abs(cosine), 1.0), eta)
    return 1.0 - reflectance


@njit_no_refcount(forceinline=True)
def _attenuate_by_medium(
    materials: MaterialArrays, medium: int, length: float, k: int, transmittance: Float32[np.ndarray, "n 3"]
) -> None:
    """Attenuate row ``k`` by a length in a medium."""
    if medium >= 0 and length < math.inf:
        for channel in range(3):
            transmittance[k, channel] *= math.exp(-materials.absorption[medium, channel] * length)


@njit_no_refcount(forceinline=True)
def _attenuate_at_start(
    materials: MaterialArrays,
    shadows: ShadowRayArrays,
    scratch: PathScratch,
    count: int,
    transmittance: Float32[np.ndarray, "n 3"],
) -> None:
    """Attenuate ``count`` rows that meet no glass by what they begin in."""
    for i in range(count):
        k = scratch.rows[i]
        _attenuate_by_medium(materials, shadows.medium_ids[k], float(shadows.t_max[k]), k, transmittance)


@njit_no_refcount(forceinline=True)
def _cross_nested_glass(
    materials: MaterialArrays,
    m: int,
    cosine: float,
    length: float,
    passes_rough_glass: bool,
    shadows: ShadowRayArrays,
    k: int,
    transmittance: Float32[np.ndarray, "n 3"],
) -> None:
    """Attenuate row ``k`` at a surface of glass with a priority, and by the ``length`` of the way there."""
    media = shadows.media[k]
    _attenuate_by_medium(materials, medium_of(materials, media), length, k, transmittance)
    is_entering = cosine <= 0.0
    hidden = is_hidden(materials, media, m, is_entering)
    near = index_of(materials, medium_of(materials, media))
    cross_surface(media, m, is_entering)
    if hidden:
        return
    far = index_of(materials, medium_of(materials, media))
    # either way as seen from the thinner side, as the direction is that in air
    eta = max(near, far) / min(near, far)
    share = _glass_share(materials.roughness[m], eta, cosine, passes_rough_glass)
    for channel in range(3):
        transmittance[k, channel] *= share * materials.colors_linear[m, channel]


@njit_no_refcount(forceinline=True)
def _trace_filters(
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
    """Attenuate ``count`` rows on their way straight through what lets light pass.

    That is glass, by Fresnel, tint and Beer's law, and what has holes, by its opacity.
    """
    # free here: where each ray met its last glass, and the glass without a priority that it is inside
    last_glass, inside = scratch.t_ends, scratch.samples
    for k in range(BLOCK_SIZE):
        scratch.t_starts[k] = last_glass[k] = 0.0
    for i in range(count):
        scratch.rows[i] -= first
        medium = shadows.medium_ids[first + scratch.rows[i]]
        inside[scratch.rows[i]] = medium if medium >= 0 and not is_nested(materials, medium) else AIR
    # Starts are kept by the row's place in the block.
    rays = TriangleRays(
        shadows.origins_world[first:], shadows.directions_world[first:], scratch.t_starts,
        shadows.t_max[first:], scratch.rows,
    )  # fmt: skip
    met = TriangleHitArrays(scratch.distances, scratch.faces, scratch.barycentrics)
    for _ in range(MAX_CUTOUTS):
        closest_hits(queries.closest_hit_filter, rays, 0, count, False, scratch.embree, met)
        left = 0
        for i in range(count):
            place = scratch.rows[i]
            k = first + place
            # rays that meet no more of it leave the list with what they have
            if scratch.faces[i] < 0:
                length = max(float(shadows.t_max[k] - last_glass[place]), 0.0)
                medium = medium_of(materials, shadows.media[k])
                medium = inside[place] if medium < 0 else medium
                _attenuate_by_medium(materials, medium, length, k, transmittance)
                continue
            face = queries.filter_faces[scratch.faces[i]]
            m = surfaces.material_ids[face]
            t = scratch.distances[i]
            if materials.kinds[m] == GLASS:
                n_x, n_y, n_z = face_normal(surfaces.corners_world[face])
                d = shadows.directions_world[k]
                cosine = n_x * d[0] + n_y * d[1] + n_z * d[2]
                length = float(t - last_glass[place])
                last_glass[place] = restart_distance(t)
                if is_nested(materials, m):
                    _cross_nested_glass(
                        materials, m, cosine, length, passes_rough_glass, shadows, k, transmittance
                    )  # fmt: skip
                else:
                    share = _glass_share(
                        materials.roughness[m], materials.iors[m], cosine, passes_rough_glass
                    )
                    # Out of the glass: what it absorbed on the way.
                    length = length if cosine > 0.0 else 0.0
                    inside[place] = m if cosine <= 0.0 else AIR
                    for channel in range(3):
                        passed = math.exp(-materials.absorption[m, channel] * length)
                        transmittance[k, channel] *= share * materials.colors_linear[m, channel] * passed
            else:
                b, c = float(scratch.barycentrics[i, 0]), float(scratch.barycentrics[i, 1])
                u, v = interpolate_uv(surfaces.corner_uv[face], 1.0 - b - c, b, c)
                alpha = eval_vertex_alpha(surfaces, face, 1.0 - b - c, b, c)
                share = 1.0 - eval_opacity(materials, m, u, v, alpha)
                for channel in range(3):
                    transmittance[k, channel] *= share
                if share <= 0.0:
                    continue
            scratch.t_starts[place] = restart_distance(t)
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
    """Write the share of light that meshes let through on each ray, in each channel.

    It is 0 or 1, but for glass and what has holes, and 0, too, for rays that bring nothing. Where a ray is
    marked so, light goes straight through glass, less what Fresnel, tint and Beer take. Paths find light that
    glass bends only where a lamp has an extent and the lit point sends paths on; everywhere else glass would
    cast the shadow of a stone. Rough glass sends paths on from its own surface, which find such light; only
    where none are sent (``passes_rough_glass``) does it let light through as if it were smooth.
    """
    for start in range(first, last, BLOCK_SIZE):
        end = min(start + BLOCK_SIZE, last)
        for k in range(start, end):
            transmittance[k, 0] = transmittance[k, 1] = transmittance[k, 2] = 0.0
        count, others = _select_shadow_rays(shadows, start, end, False, scratch.rows)
        count = _trace_occlusion(queries.any_hit, shadows, scratch, count, transmittance)
        if queries.any_cutout:
            _trace_filters(
                queries, surfaces, materials, shadows, start, scratch, count, False, transmittance
            )  # fmt: skip
        else:
            _attenuate_at_start(materials, shadows, scratch, count, transmittance)
        if others == 0:
            continue
        count, _ = _select_shadow_rays(shadows, start, end, True, scratch.rows)
        count = _trace_occlusion(queries.any_hit_opaque, shadows, scratch, count, transmittance)
        if queries.closest_hit_filter.scene != 0:
            _trace_filters(
                queries, surfaces, materials, shadows, start, scratch, count, passes_rough_glass,
                transmittance,
            )  # fmt: skip
