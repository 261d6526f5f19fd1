"""Rays through triangles: Embree's own tests, called in a loop."""

import numpy as np
from numba import njit, prange

from engine.trace.kernels_native import call_with_three_pointers

# --- RTCRayHit in 32-bit words ---
T_NEAR, T_FAR, MASK, ID, FLAGS = 3, 8, 9, 10, 11
U, V, FACE, GEOMETRY, INSTANCE = 15, 16, 17, 18, 19
RAY_WORDS = 32
NO_HIT = -1


@njit(error_model="numpy")
def _write_ray(words, origins, directions, t_min, t_max, r):
    """Fill in the query of ray ``r``; a single origin or limit stands for all rays."""
    whole = words.view(np.int32)
    o = r if len(origins) > 1 else 0
    for axis in range(3):
        words[axis] = origins[o, axis]
        words[4 + axis] = directions[r, axis]
    words[7] = np.float32(0.0)
    words[T_NEAR] = t_min[r if len(t_min) > 1 else 0]
    words[T_FAR] = t_max[r if len(t_max) > 1 else 0]
    whole[MASK], whole[ID], whole[FLAGS] = -1, 0, 0
    whole[FACE], whole[GEOMETRY], whole[INSTANCE] = NO_HIT, NO_HIT, NO_HIT


@njit(cache=True, nogil=True, error_model="numpy")
def closest_hits(
    intersect1, scene, origins, directions, t_min, t_max, first, last, distances, faces, barycentrics
):
    """The first triangle on rays ``first`` to ``last``."""
    words = np.empty(RAY_WORDS, np.float32)
    whole = words.view(np.int32)
    for r in range(first, last):
        _write_ray(words, origins, directions, t_min, t_max, r)
        call_with_three_pointers(intersect1, scene, words.ctypes.data, 0)
        faces[r] = whole[FACE]
        hit = whole[FACE] != NO_HIT
        distances[r] = words[T_FAR] if hit else np.float32(np.inf)
        barycentrics[r, 0] = words[U] if hit else np.float32(0.0)
        barycentrics[r, 1] = words[V] if hit else np.float32(0.0)


@njit(cache=True, nogil=True, error_model="numpy")
def any_hits(occluded1, scene, origins, directions, t_min, t_max, first, last, occluded):
    """Whether any triangle lies on rays ``first`` to ``last``."""
    words = np.empty(RAY_WORDS, np.float32)
    for r in range(first, last):
        _write_ray(words, origins, directions, t_min, t_max, r)
        empty = not words[T_NEAR] <= words[T_FAR]  # Embree would call this a hit
        call_with_three_pointers(occluded1, scene, words.ctypes.data, 0)
        occluded[r] = words[T_FAR] == -np.inf and not empty


@njit(cache=True, parallel=True, error_model="numpy")
def closest_hits_side_by_side(
    intersect1, scene, origins, directions, t_min, t_max, chunks, distances, faces, barycentrics
):
    """:func:`closest_hits` on all rays and several threads."""
    count = len(directions)
    for c in prange(chunks):
        closest_hits(
            intersect1, scene, origins, directions, t_min, t_max,
            c * count // chunks, (c + 1) * count // chunks, distances, faces, barycentrics,
        )  # fmt: skip


@njit(cache=True, parallel=True, error_model="numpy")
def any_hits_side_by_side(occluded1, scene, origins, directions, t_min, t_max, chunks, occluded):
    """:func:`any_hits` on all rays and several threads."""
    count = len(directions)
    for c in prange(chunks):
        first, last = c * count // chunks, (c + 1) * count // chunks
        any_hits(occluded1, scene, origins, directions, t_min, t_max, first, last, occluded)
