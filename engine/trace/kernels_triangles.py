"""Rays through triangles: Embree's own tests of eight rays at a time, called in a loop.

Embree gives each ray of eight what it would give that ray alone.
"""

from typing import NamedTuple

import numpy as np
from numba import prange

from octasplat.engine.compilation import kernel
from octasplat.engine.trace.kernels_native import call_with_four_pointers, lean

LANES = 8
# --- RTCRayHit8: a row of eight 32-bit words each ---
ORIGIN, T_NEAR, DIRECTION, TIME, T_FAR, MASK, ID, FLAGS = 0, 3, 4, 7, 8, 9, 10, 11
U, V, FACE, GEOMETRY, INSTANCE = 15, 16, 17, 18, 19
# --- behind it in the scratch memory: which lanes count, and RTCIntersectArguments ---
VALID, ARGUMENTS = 24, 25
SCRATCH_ROWS = 26
COHERENT = 1 << 16
EVERY_FEATURE = -1
NO_HIT = -1


class TriangleQuery(NamedTuple):
    """Addresses of a function of Embree for eight rays, and of the scene that it is to search."""

    function: int
    scene: int


@lean()
def _ask(query, origins, directions, t_min, t_max, which, k, last, coherent, words):
    """Search along rays ``k`` and the next ones before ``last``; a single origin or limit stands for all."""
    whole = words.view(np.int32)
    for lane in range(LANES):
        at = min(k + lane, last - 1)
        r = which[at] if len(which) else at
        o = r if len(origins) > 1 else 0
        for axis in range(3):
            words[(ORIGIN + axis) * LANES + lane] = origins[o, axis]
            words[(DIRECTION + axis) * LANES + lane] = directions[r, axis]
        near, far = t_min[r if len(t_min) > 1 else 0], t_max[r if len(t_max) > 1 else 0]
        words[T_NEAR * LANES + lane] = near
        words[T_FAR * LANES + lane] = far
        words[TIME * LANES + lane] = np.float32(0.0)
        whole[MASK * LANES + lane] = -1
        whole[ID * LANES + lane] = 0
        whole[FLAGS * LANES + lane] = 0
        whole[FACE * LANES + lane] = NO_HIT
        whole[GEOMETRY * LANES + lane] = NO_HIT
        whole[INSTANCE * LANES + lane] = NO_HIT
        whole[VALID * LANES + lane] = -1 if k + lane < last and near <= far else 0
    whole[ARGUMENTS * LANES] = COHERENT if coherent else 0
    whole[ARGUMENTS * LANES + 1] = EVERY_FEATURE
    for word in range(2, 8):
        whole[ARGUMENTS * LANES + word] = 0
    address = words.ctypes.data
    call_with_four_pointers(
        query.function, address + 4 * VALID * LANES, query.scene, address, address + 4 * ARGUMENTS * LANES
    )


@kernel(_nrt=False, error_model="numpy")
def closest_hits(
    query, origins, directions, t_min, t_max, which, first, last, coherent, scratch,
    distances, faces, barycentrics,
):  # fmt: skip
    """The first triangle on each ray; rows ``first`` to ``last`` of the results get it.

    ``which`` says the ray of each row and is empty where they are the same; ``coherent`` whether neighbours
    go about one way. ``scratch`` is one thread's own 26 rows of 8 words, which begin on a cache line.
    """
    whole = scratch.view(np.int32)
    for k in range(first, last, LANES):
        _ask(query, origins, directions, t_min, t_max, which, k, last, coherent, scratch)
        for lane in range(min(LANES, last - k)):
            face = whole[FACE * LANES + lane]
            faces[k + lane] = face
            hit = face != NO_HIT
            distances[k + lane] = scratch[T_FAR * LANES + lane] if hit else np.float32(np.inf)
            barycentrics[k + lane, 0] = scratch[U * LANES + lane] if hit else np.float32(0.0)
            barycentrics[k + lane, 1] = scratch[V * LANES + lane] if hit else np.float32(0.0)


@kernel(_nrt=False, error_model="numpy")
def any_hits(query, origins, directions, t_min, t_max, which, first, last, scratch, occluded):
    """Whether any triangle lies on each ray; see :func:`closest_hits`."""
    for k in range(first, last, LANES):
        _ask(query, origins, directions, t_min, t_max, which, k, last, False, scratch)
        for lane in range(min(LANES, last - k)):
            occluded[k + lane] = scratch[T_FAR * LANES + lane] == -np.inf


@kernel(parallel=True, error_model="numpy")
def closest_hits_side_by_side(
    query, origins, directions, t_min, t_max, which, scratch, distances, faces, barycentrics
):
    """:func:`closest_hits` on all rays and several threads; ``scratch`` has a row for each chunk of them."""
    count, chunks = len(directions), len(scratch)
    for c in prange(chunks):
        closest_hits(
            query, origins, directions, t_min, t_max, which, c * count // chunks, (c + 1) * count // chunks,
            False, scratch[c], distances, faces, barycentrics,
        )  # fmt: skip


@kernel(parallel=True, error_model="numpy")
def any_hits_side_by_side(query, origins, directions, t_min, t_max, which, scratch, occluded):
    """:func:`any_hits` on all rays and several threads."""
    count, chunks = len(directions), len(scratch)
    for c in prange(chunks):
        any_hits(
            query, origins, directions, t_min, t_max, which, c * count // chunks, (c + 1) * count // chunks,
            scratch[c], occluded,
        )  # fmt: skip
