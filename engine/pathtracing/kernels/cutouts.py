"""Surfaces that rays pass: those with holes where nothing is there, and those of glass within other glass.

A texture of opacities, as of a leaf, the alpha of vertices, or one number, as of gauze. With a cutoff a place
is there or not; without one its opacity is the probability with which a path meets it, and the share of light
that it keeps off. A path passes what is not there as if there were no surface: its place, its direction and
the number of surfaces that it has met stay as they are. So it passes surfaces of glass within glass that
counts instead, see :mod:`octasplat.engine.pathtracing.kernels.nested_glass`.
"""

import math

import numpy as np

from octasplat.engine.core.compilation import kernel
from octasplat.engine.pathtracing.kernels.kernel_args import (
    LightArrays,
    MaterialArrays,
    MeshQueries,
)
from octasplat.engine.pathtracing.kernels.nested_glass import (
    copy_media,
    cross_surface,
    is_hidden,
    is_nested,
)
from octasplat.engine.pathtracing.kernels.path_args import BLOCK_SIZE, Bounce, PathScratch
from octasplat.engine.pathtracing.kernels.sampler import uniform_pair
from octasplat.engine.pathtracing.kernels.surface import eval_vertex_alpha, face_normal, interpolate_uv
from octasplat.engine.pathtracing.kernels.texture import eval_texture
from octasplat.engine.trace.kernels.native import njit_no_refcount
from octasplat.engine.trace.kernels.triangles import TriangleHitArrays, TriangleRays, closest_hits

MAX_CUTOUTS = 1024
"""Surfaces that one ray passes and that have random numbers of their own."""
FIRST_CUTOUT_PAIR = 1 << 13
"""Pairs of numbers behind those of meshes and of Gaussians."""
RESTART_SCALE = np.float32(1 + 1e-6)
RESTART_OFFSET = np.float32(1e-7)


@njit_no_refcount(forceinline=True)
def has_holes(materials: LightArrays | MaterialArrays, m: int) -> bool:
    """Return whether some of a material's surface may not be there."""
    return (
        materials.opacity_textures[m] >= 0
        or materials.opacities[m] < 1.0
        or materials.uses_vertex_alpha[m] != 0
    )


@njit_no_refcount(forceinline=True)
def eval_opacity(
    materials: LightArrays | MaterialArrays, m: int, u: float, v: float, vertex_alpha: float
) -> float:
    """Return the share of a surface that is there at texture coordinates, where its corners have an alpha."""
    opacity = materials.opacities[m] * vertex_alpha
    texture = materials.opacity_textures[m]
    if texture >= 0:
        opacity *= eval_texture(materials, texture, u, v)[0]
    cutoff = materials.opacity_cutoffs[m]
    if cutoff < 0.0:
        return opacity
    return 1.0 if opacity >= cutoff else 0.0


@njit_no_refcount(forceinline=True)
def restart_distance(t: np.float32) -> np.float32:
    """Return where a ray goes on behind a surface at ``t``: by more than the rounding of ``t``."""
    return np.float32(t * RESTART_SCALE + RESTART_OFFSET)


@njit_no_refcount(forceinline=True)
def _is_passed(bounce: Bounce, k: int, face: int, b: float, c: float, pair: int) -> bool:
    """Return whether a path finds nothing at a place of a face, with its random number of a pair.

    Glass within other glass is noted in the list of row ``k``.
    """
    paths, p, scene, media = bounce.paths, bounce.active[k], bounce.scene, bounce.hits.media
    m = scene.surfaces.material_ids[face]
    if is_nested(scene.materials, m):
        n_x, n_y, n_z = face_normal(scene.surfaces.corners_world[face])
        d = paths.directions_world[p]
        is_entering = d[0] * n_x + d[1] * n_y + d[2] * n_z <= 0.0
        if not is_hidden(scene.materials, media[k], m, is_entering):
            return False
        cross_surface(media[k], m, is_entering)
        return True
    if not has_holes(scene.materials, m):
        return False
    u, v = interpolate_uv(scene.surfaces.corner_uv[face], 1.0 - b - c, b, c)
    alpha = eval_vertex_alpha(scene.surfaces, face, 1.0 - b - c, b, c)
    opacity = eval_opacity(scene.materials, m, u, v, alpha)
    if opacity >= 1.0 or opacity <= 0.0:
        return opacity <= 0.0
    return uniform_pair(paths.keys[p], paths.samples[p], pair)[0] >= opacity


@kernel(_nrt=False, error_model="numpy")
def pass_surfaces(first: int, last: int, scratch: PathScratch, queries: MeshQueries, bounce: Bounce) -> None:
    """Move the hits of the rows ``first`` to ``last`` from what rays pass to what they meet behind it."""
    paths, active, hits, scene = bounce.paths, bounce.active, bounce.hits, bounce.scene
    met = TriangleHitArrays(scratch.distances, scratch.faces, scratch.barycentrics)
    rays = TriangleRays(
        scratch.origins, scratch.directions, scratch.t_starts, scratch.t_ends, scratch.rows[:0]
    )
    if scene.any_nested:
        for k in range(first, last):
            copy_media(paths.media[active[k]], hits.media[k])
    for start in range(first, last, BLOCK_SIZE):
        pair = FIRST_CUTOUT_PAIR + bounce.depth * MAX_CUTOUTS
        count = 0
        for k in range(start, min(start + BLOCK_SIZE, last)):
            face = hits.faces[k]
            if face >= 0:
                b, c = float(hits.barycentrics[k, 0]), float(hits.barycentrics[k, 1])
                if _is_passed(bounce, k, face, b, c, pair):
                    scratch.rows[count] = k
                    count += 1
        crossed = 0
        while count > 0:
            crossed = min(crossed + 1, MAX_CUTOUTS - 1)
            # --- the rays go on behind the surface ---
            for i in range(count):
                k = scratch.rows[i]
                p = active[k]
                for axis in range(3):
                    scratch.origins[i, axis] = paths.origins_world[p, axis]
                    scratch.directions[i, axis] = paths.directions_world[p, axis]
                scratch.t_starts[i] = restart_distance(hits.distances[k])
                scratch.t_ends[i] = math.inf
            closest_hits(queries.closest_hit, rays, 0, count, False, scratch.embree, met)
            # --- those that pass another one stay in the list ---
            left = 0
            for i in range(count):
                k = scratch.rows[i]
                face = scratch.faces[i]
                # by rounding it may be the same place
                is_same = face == hits.faces[k]
                hits.faces[k], hits.distances[k] = face, scratch.distances[i]
                b, c = float(scratch.barycentrics[i, 0]), float(scratch.barycentrics[i, 1])
                hits.barycentrics[k, 0], hits.barycentrics[k, 1] = b, c
                if face >= 0 and (is_same or _is_passed(bounce, k, face, b, c, pair + crossed)):
                    scratch.rows[left] = k
                    left += 1
            count = left
