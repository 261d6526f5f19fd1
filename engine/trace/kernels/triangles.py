"""Rays through triangles: Embree's own tests of eight rays at a time, called in a loop.

Embree gives each ray of eight what it would give that ray alone.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Int32

from octasplat.engine.core.compilation import kernel
from octasplat.engine.trace.kernels.native import Address, call_with_four_pointers, njit_no_refcount

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

    function: Address
    scene: Address


class TriangleRays(NamedTuple):
    """Rays to be searched along; a single origin or limit stands for all.

    ``ray_indices`` has the ray of each row of the results, and no entries where they are the same.
    """

    origins: Float32[np.ndarray, "#r 3"]
    directions: Float32[np.ndarray, "r 3"]
    t_min: Float32[np.ndarray, "#r"]
    t_max: Float32[np.ndarray, "#r"]
    ray_indices: Int32[np.ndarray, " q"]


class TriangleHitArrays(NamedTuple):
    """First hits, to be written: the face is -1 and the distance infinite where a ray meets nothing."""

    distances: Float32[np.ndarray, " q"]
    faces: Int32[np.ndarray, " q"]
    barycentrics: Float32[np.ndarray, "q 2"]


@njit_no_refcount()
def _prepare_queries(is_coherent: bool, scratch: Float32[np.ndarray, " w"]) -> None:
    """Write what all calls of Embree have in common and leave as it is."""
    words = scratch.view(np.int32)
    for lane in range(LANES):
        scratch[TIME * LANES + lane] = np.float32(0.0)
        words[MASK * LANES + lane] = -1
        words[ID * LANES + lane] = 0
        words[FLAGS * LANES + lane] = 0
        words[INSTANCE * LANES + lane] = INVALID_ID
    # --- RTCIntersectArguments ---
    words[ARGUMENTS * LANES] = RTC_RAY_QUERY_FLAG_COHERENT if is_coherent else 0
    words[ARGUMENTS * LANES + 1] = RTC_FEATURE_FLAG_ALL
    for word in range(2, 8):
        words[ARGUMENTS * LANES + word] = 0


@njit_no_refcount()
def _query_rays8(
    query: EmbreeQuery,
    rays: TriangleRays,
    row: int,
    end: int,
    scratch: Float32[np.ndarray, " w"],
) -> None:
    """Trace up to eight rays, from ``row`` on and before ``end``, after :func:`_prepare_queries`."""
    words = scratch.view(np.int32)
    # a single origin or limit stands for all rays
    each_origin = 1 if len(rays.origins) > 1 else 0
    each_near, each_far = 1 if len(rays.t_min) > 1 else 0, 1 if len(rays.t_max) > 1 else 0
    is_indirect = len(rays.ray_indices) > 0
    # --- the rays, a lane each ---
    for lane in range(LANES):
        lane_row = min(row + lane, end - 1)  # lanes beyond the end repeat the last ray, but are not valid
        # unsigned: no place is counted from the end of an array
        r = np.uintp(rays.ray_indices[np.uintp(lane_row)]) if is_indirect else np.uintp(lane_row)
        origin, direction = rays.origins[r * np.uintp(each_origin)], rays.directions[r]
        near, far = rays.t_min[r * np.uintp(each_near)], rays.t_max[r * np.uintp(each_far)]
        scratch[ORIGIN * LANES + lane] = origin[0]
        scratch[(ORIGIN + 1) * LANES + lane] = origin[1]
        scratch[(ORIGIN + 2) * LANES + lane] = origin[2]
        scratch[DIRECTION * LANES + lane] = direction[0]
        scratch[(DIRECTION + 1) * LANES + lane] = direction[1]
        scratch[(DIRECTION + 2) * LANES + lane] = direction[2]
        scratch[T_NEAR * LANES + lane] = near
        scratch[T_FAR * LANES + lane] = far
        words[VALID * LANES + lane] = -1 if row + lane < end and near <= far else 0
        words[GEOMETRY * LANES + lane] = INVALID_ID  # only a hit has a face and an instance
    address = scratch.ctypes.data
    call_with_four_pointers(
        query.function, address + 4 * VALID * LANES, query.scene, address, address + 4 * ARGUMENTS * LANES
    )


@njit_no_refcount()
def closest_hits(
    query: EmbreeQuery,
    rays: TriangleRays,
    first: int,
    last: int,
    is_coherent: bool,
    scratch: Float32[np.ndarray, " w"],
    out: TriangleHitArrays,
) -> None:
    """Find the first triangle on each of the rays of rows ``first`` to ``last``.

    ``is_coherent`` tells whether neighbours have about one direction. ``scratch`` is one thread's own
    :data:`SCRATCH_ROWS` rows of 8 words, which begin on a cache line.
    """
    words = scratch.view(np.int32)
    _prepare_queries(is_coherent, scratch)
    for k in range(first, last, LANES):
        _query_rays8(query, rays, k, last, scratch)
        for lane in range(min(LANES, last - k)):
            hit, row = words[GEOMETRY * LANES + lane] != INVALID_ID, np.uintp(k + lane)
            out.faces[row] = words[FACE * LANES + lane] if hit else -1
            out.distances[row] = scratch[T_FAR * LANES + lane] if hit else np.float32(np.inf)
            out.barycentrics[row, 0] = scratch[U * LANES + lane] if hit else np.float32(0.0)
            out.barycentrics[row, 1] = scratch[V * LANES + lane] if hit else np.float32(0.0)


@njit_no_refcount()
def any_hits(
    query: EmbreeQuery,
    rays: TriangleRays,
    first: int,
    last: int,
    scratch: Float32[np.ndarray, " w"],
    occluded: Bool[np.ndarray, " q"],
) -> None:
    """Find whether any triangle lies on each of the rays of rows ``first`` to ``last``."""
    _prepare_queries(False, scratch)
    for k in range(first, last, LANES):
        _query_rays8(query, rays, k, last, scratch)
        for lane in range(min(LANES, last - k)):
            occluded[k + lane] = scratch[T_FAR * LANES + lane] == -np.inf  # Embree's sign for a hit


@kernel(_nrt=False, error_model="numpy")
def write_closest_hits(
    first: int,
    last: int,
    query: EmbreeQuery,
    rays: TriangleRays,
    scratch: Float32[np.ndarray, "c w"],
    out: TriangleHitArrays,
) -> None:
    """Find the first triangle on each of the rays of the chunks ``first`` to ``last``.

    ``scratch`` has a row for each of the chunks into which all rays are cut.
    """
    count, chunks = len(rays.directions), len(scratch)
    for c in range(first, last):
        closest_hits(query, rays, c * count // chunks, (c + 1) * count // chunks, False, scratch[c], out)


@kernel(_nrt=False, error_model="numpy")
def write_any_hits(
    first: int,
    last: int,
    query: EmbreeQuery,
    rays: TriangleRays,
    scratch: Float32[np.ndarray, "c w"],
    occluded: Bool[np.ndarray, " q"],
) -> None:
    """Find whether any triangle lies on each of the rays of the chunks ``first`` to ``last``."""
    count, chunks = len(rays.directions), len(scratch)
    for c in range(first, last):
        any_hits(query, rays, c * count // chunks, (c + 1) * count // chunks, scratch[c], occluded)
