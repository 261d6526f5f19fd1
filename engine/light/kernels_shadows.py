"""What meshes keep off and let through between lit points and lights."""

import math

import numpy as np

from octasplat.engine.compilation import kernel
from octasplat.engine.light.arrays import BLOCK
from octasplat.engine.light.kernels_bsdf import fresnel_dielectric
from octasplat.engine.light.kernels_frosted import LEAST_FROST
from octasplat.engine.light.kernels_surface import face_normal
from octasplat.engine.trace.kernels_native import lean
from octasplat.engine.trace.kernels_triangles import any_hits, closest_hits

MOST_SURFACES = 16
PAST = np.float32(1 + 1e-6)
BEYOND = np.float32(1e-7)


@lean(forceinline=True)
def _asked(shadows, first, last, straight, rows):
    """The rows of shadow rays that bring anything, the straight ones or the others, and how many."""
    count = 0
    for k in range(first, last):
        brings = shadows.lit[k, 0] + shadows.lit[k, 1] + shadows.lit[k, 2] > 0.0
        takes = shadows.lost[k, 0] + shadows.lost[k, 1] + shadows.lost[k, 2] < 0.0
        if (brings or takes) and shadows.straight[k] == straight:
            rows[count] = k
            count += 1
    return count


@lean(forceinline=True)
def _block(query, shadows, scratch, count, share):
    """Take the light from those of the first ``count`` rows that something is in the way of."""
    scratch.starts[0] = 0.0
    any_hits(
        query, shadows.origins_world, shadows.directions_world, scratch.starts[:1], shadows.t_max,
        scratch.rows, 0, count, scratch.embree, scratch.blocked,
    )  # fmt: skip
    left = 0
    for i in range(count):
        k = scratch.rows[i]
        free = not scratch.blocked[i]
        share[k, 0] = share[k, 1] = share[k, 2] = 1.0 if free else 0.0
        if free:
            scratch.rows[left] = k
            left += 1
    return left


@lean(forceinline=True)
def _through_glass(queries, surfaces, materials, shadows, first, scratch, count, through_frost, share):
    """Take what Fresnel, tint and Beer take from ``count`` rows on their way straight through glass."""
    for k in range(BLOCK):
        scratch.starts[k] = 0.0
    for _ in range(MOST_SURFACES):
        # Starts are kept by the row's place in the block.
        closest_hits(
            queries.closest_glass, shadows.origins_world[first:], shadows.directions_world[first:],
            scratch.starts, shadows.t_max[first:], scratch.rows, 0, count, False, scratch.embree,
            scratch.distances, scratch.faces, scratch.barycentrics,
        )  # fmt: skip
        left = 0
        for i in range(count):
            if scratch.faces[i] < 0:
                continue
            place = scratch.rows[i]
            k = first + place
            face = queries.glass_faces[scratch.faces[i]]
            m = surfaces.materials[face]
            n_x, n_y, n_z = face_normal(surfaces.corners_world[face])
            d = shadows.directions_world[k]
            cosine = n_x * d[0] + n_y * d[1] + n_z * d[2]
            kept, _ = fresnel_dielectric(min(abs(cosine), 1.0), materials.iors[m])
            kept = 1.0 - kept
            if not through_frost and materials.roughness[m] >= LEAST_FROST and materials.iors[m] != 1.0:
                kept = 0.0
            t = scratch.distances[i]
            # Out of the glass: what it absorbed on the way.
            length = float(t - scratch.starts[place]) if cosine > 0.0 else 0.0
            for channel in range(3):
                passed = math.exp(-materials.absorption[m, channel] * length)
                share[k, channel] *= kept * materials.colours_linear[m, channel] * passed
            scratch.starts[place] = t * PAST + BEYOND
            scratch.rows[left] = place
            left += 1
        count = left
        if count == 0:
            break


@kernel(_nrt=False, error_model="numpy")
def let_through(first, last, scratch, queries, surfaces, materials, shadows, through_frost, share):
    """The share of light that meshes let through on each ray, in each channel: 0 or 1, but for glass.

    It is 0, too, for rays that bring nothing. Where a ray is marked so, light goes straight through glass,
    less what Fresnel, tint and Beer take. Paths find light that glass bends only where a lamp has an extent
    and the lit point sends paths on; everywhere else glass would cast the shadow of a stone. Rough glass
    sends paths on from its own surface, which find such light; only where none are sent (``through_frost``)
    does it let light through as if it were smooth.
    """
    for start in range(first, last, BLOCK):
        end = min(start + BLOCK, last)
        for k in range(start, end):
            share[k, 0] = share[k, 1] = share[k, 2] = 0.0
        count = _asked(shadows, start, end, False, scratch.rows)
        _block(queries.any, shadows, scratch, count, share)
        count = _asked(shadows, start, end, True, scratch.rows)
        count = _block(queries.any_obstacle, shadows, scratch, count, share)
        if queries.closest_glass.scene != 0:
            for i in range(count):
                scratch.rows[i] -= start
            _through_glass(queries, surfaces, materials, shadows, start, scratch, count, through_frost, share)
