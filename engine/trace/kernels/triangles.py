"""Rays through triangles: Embree's own tests of eight rays at a time, called in a loop.

Embree gives each ray of eight what it would give that ray alone.
"""

from typing import NamedTuple

import numpy as np
from numba import prange

from octasplat.engine.core.compilation import kernel
from octasplat.engine.trace.kernels.native import call_with_four_pointers, njit_no_refcount

LANES = 8
# --- RTCRayHit8: a row of eight 32-bit words each ---
ORIGIN, T_NEAR, DIRECTION, TIME, T_FAR, MASK, ID, FLAGS = 0, 3, 4, 7, 8, 9, 10, 11
U, V, FACE, GEOMETRY, INSTANCE = 15, 16, 17, 18, 19
# --- behind it in the scratch memory: which lanes count, and RTCIntersectArguments ---
VALID, ARGUMENTS = 24, 25
SCRATCH_ROWS = 26
RTC_RAY_QUERY_FLAG_COHERENT = 1 << 16
RTC_FEATURE_FLAG_ALL = -1
INVALID_ID = -1


class EmbreeQuery(NamedTuple):
    """Addresses of a function of Embree for eight rays, and of the scene that it is to search."""

    function: int
    scene: int


@njit_no_refcount()
def _query_rays8(query, origins, directions, t_min, t_max, ray_indices, first, last, is_coherent, scratch):
    """Search along rays ``first`` and the next ones before ``last``; a single origin or limit stands for all."""
    whole = scratch.view(np.int32)
    for lane in range(LANES):
        at = min(first + lane, last - 1)
        r = ray_indices[at] if len(ray_indices) else at
        o = r if len(origins) > 1 else 0
        for axis in range(3):
            scratch[(ORIGIN + axis) * LANES + lane] = origins[o, axis]
            scratch[(DIRECTION + axis) * LANES + lane] = directions[r, axis]
        near, far = t_min[r if len(t_min) > 1 else 0], t_max[r if len(t_max) > 1 else 0]
        scratch[T_NEAR * LANES + lane] = near
        scratch[T_FAR * LANES + lane] = far
        scratch[TIME * LANES + lane] = np.float32(0.0)
        whole[MASK * LANES + lane] = -1
        whole[ID * LANES + lane] = 0
        whole[FLAGS * LANES + lane] = 0
        whole[FACE * LANES + lane] = INVALID_ID
        whole[GEOMETRY * LANES + lane] = INVALID_ID
        whole[INSTANCE * LANES + lane] = INVALID_ID
        whole[VALID * LANES + lane] = -1 if first + lane < last and near <= far else 0
    whole[ARGUMENTS * LANES] = RTC_RAY_QUERY_FLAG_COHERENT if is_coherent else 0
    whole[ARGUMENTS * LANES + 1] = RTC_FEATURE_FLAG_ALL
    for word in range(2, 8):
        whole[ARGUMENTS * LANES + word] = 0
    address = scratch.ctypes.data
    call_with_four_pointers(
        query.function, address + 4 * VALID * LANES, query.scene, address, address + 4 * ARGUMENTS * LANES
    )


@kernel(_nrt=False, error_model="numpy")
def closest_hits(
    query, origins, directions, t_min, t_max, ray_indices, first, last, is_coherent, scratch,
    distances, faces, barycentrics,
):  # fmt: skip
    """The first triangle on each ray; rows ``first`` to ``last`` of the results get it.

    ``ray_indices`` says the ray of each row and is empty where they are the same; ``is_coherent`` whether neighbours
    go about one way. ``scratch`` is one thread's own 26 rows of 8 words, which begin on a cache line.
    """
    whole = scratch.view(np.int32)
    for k in range(first, last, LANES):
        _query_rays8(query, origins, directions, t_min, t_max, ray_indices, k, last, is_coherent, scratch)
        for lane in range(min(LANES, last - k)):
            face = whole[FACE * LANES + lane]
            faces[k + lane] = face
            hit = face != INVALID_ID
            distances[k + lane] = scratch[T_FAR * LANES + lane] if hit else np.float32(np.inf)
            barycentrics[k + lane, 0] = scratch[U * LANES + lane] if hit else np.float32(0.0)
            barycentrics[k + lane, 1] = scratch[V * LANES + lane] if hit else np.float32(0.0)


@kernel(_nrt=False, error_model="numpy")
def any_hits(query, origins, directions, t_min, t_max, ray_indices, first, last, scratch, occluded):
    """Whether any triangle lies on each ray; see :func:`closest_hits`."""
    for k in range(first, last, LANES):
        _query_rays8(query, origins, directions, t_min, t_max, ray_indices, k, last, False, scratch)
        for lane in range(min(LANES, last - k)):
            occluded[k + lane] = scratch[T_FAR * LANES + lane] == -np.inf


@kernel(parallel=True, error_model="numpy")
def closest_hits_parallel(
    query, origins, directions, t_min, t_max, ray_indices, scratch, distances, faces, barycentrics
):
    """:func:`closest_hits` on all rays and several threads; ``scratch`` has a row for each chunk of them."""
    count, chunks = len(directions), len(scratch)
    for c in prange(chunks):
        closest_hits(
            query, origins, directions, t_min, t_max, ray_indices, c * count // chunks, (c + 1) * count // chunks,
            False, scratch[c], distances, faces, barycentrics,
        )  # fmt: skip


@kernel(parallel=True, error_model="numpy")
def any_hits_parallel(query, origins, directions, t_min, t_max, ray_indices, scratch, occluded):
    """:func:`any_hits` on all rays and several threads."""
    count, chunks = len(directions), len(scratch)
    for c in prange(chunks):
        any_hits(
            query, origins, directions, t_min, t_max, ray_indices, c * count // chunks, (c + 1) * count // chunks,
            scratch[c], occluded,
        )  # fmt: skip
