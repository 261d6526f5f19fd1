r"""Packets of rays that share an origin: which Gaussians may they meet, and these Gaussians' rows for SIMD.

    Seen from the side, with the packet's rays between d0 and d63:

                                  . - '  d0             o         origin of all rays, wherever each begins
                          . - '  /e2                    [A] [B]   boxes over eight Gaussians each
                  . - '         /                       e1 e2     ellipses of candidates, seen edge on
          . - '    [A]   |                              b         slope across the axis (a: out of the page)
      o  - - - - - - - - | - - - - - -  axis            safe      no later chunk has a hit before this
          ' - .       e1 |
                  ' - .              [B]
                          ' - .
                                  ' - .  d63
      |<----- safe ----->|

1. One walk down the hierarchy finds the blocks of eight Gaussians whose box reaches into the pyramid (A, not
   B), and of these Gaussians those whose ellipse does: the candidates, once for all 64 rays
   (:mod:`octasplat.engine.trace.cpu.kernels.packet_traversal`).
2. The outline of an ellipse, seen from o, lies between two slopes a and two slopes b. Tables over 64 bins of
   each give the rays in between as the bits of one word. A candidate without a bit lies between the rays.
3. Candidates are sorted by their likely distance and cut into chunks of 128. Within a chunk those that the
   same rays may meet come together, so that a block of eight has few bits.
4. Each ray tests the blocks that have its bit, eight octagons at once, sorts what it has met, and composites
   the hits before "safe", eight at once. It ends where its transmittance says so; what lies behind is never
   tested. A Gaussian has one color for all rays of the packet, found when the first of them meets it.
5. Backwards, the rays of a packet sum their shares of a Gaussian in one row of moments, which is enough as
   all share o (:mod:`octasplat.engine.trace.cpu.kernels.packet_reduction`). Rows are sorted and summed by
   Gaussian.

Steps 1 to 3 leave out only what no ray meets. Rows are computed in float64 from the record, in the packet's
frame, and rounded to float32, in which rays are tested: what is lost is 1e-7 of a slope against the axis, the
last digit of a direction in float32. So a ray has the same hits in any packet and alone but at the edges of
octagons, at distances that differ in the last digits of float32; and edge on, where a distance is as
uncertain as the record's normal, by up to a slope times 4e-7 over the cosine.
"""

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.trace.cpu.kernels.kernel_args import (
    BvhArrays,
    Candidates,
    Frustum,
    PackedScene,
    RayArrays,
    TraversalScratch,
)
from octasplat.engine.trace.cpu.kernels.octagon_hit import (
    AXIS_U,
    AXIS_V,
    INNER_RADIUS,
    MEAN,
    NORMAL,
    OPACITY,
    PRIMITIVE_WORDS,
)
from octasplat.engine.trace.cpu.kernels.packet_bvh import WIDTH
from octasplat.engine.trace.cpu.kernels.packet_traversal import gather_candidates, write_frustum
from octasplat.engine.trace.cpu.kernels.rays import primitive_vector, ray_origin
from octasplat.engine.trace.cpu.kernels.simd8 import A_X, ALPHA_0, B_X, INNER_RADIUS_ROW, N_0, N_X, ROWS
from octasplat.engine.trace.kernels.native import CACHE_LINE_BYTES, njit_no_refcount, prefetch

CANDIDATE_BLOCK_BYTES = ROWS * WIDTH * 4
PREFETCH_DISTANCE = 8
"""Candidates between asking for a record and reading it: about as long as memory takes to answer."""
PRIMITIVE_BYTES = PRIMITIVE_WORDS * 4
CHUNK = 128
"""Candidates that a ray tests before it composites what lies safely in front of the rest.

Small enough that rays which end early leave most candidates untested, large enough that the sorting of a
ray's hits, once a chunk, does not show; a chunk's rows (6 kB) stay in the first cache.
"""
MASK_BITS = 64
"""Blocks whose bits make one word of a ray's."""
COLOR_NORMAL_WORDS = 8
"""What a Gaussian shows to a packet: its color, 0, the normal turned towards the origin, 0."""
INITIAL_CAPACITY = 512
"""Candidates that a thread has room for at first; a packet that has more makes it grow."""


@device_function(error_model="numpy")
def allocate_aligned_float64(count: int) -> Float64[np.ndarray, " count"]:
    """Return room for doubles from a line on, else each vector of eight would lie in two."""
    raw = np.empty(count + CACHE_LINE_BYTES // 8, np.float64)
    first = (CACHE_LINE_BYTES - raw.ctypes.data % CACHE_LINE_BYTES) % CACHE_LINE_BYTES // 8
    return raw[first : first + count]


@device_function(error_model="numpy")
def allocate_candidates(capacity: int) -> Candidates:
    """Return room for so many candidates, a multiple of eight."""
    return Candidates(
        np.empty(capacity, np.int32),
        np.empty(capacity, np.uint64),
        np.empty(capacity, np.float32),
        np.empty(capacity, np.int32),
        np.empty(capacity, np.uint64),
        np.empty(capacity, np.int32),
        np.empty(capacity + 1, np.float32),
        np.empty(capacity // WIDTH, np.uint64),
        np.empty((capacity // (WIDTH * MASK_BITS) + 1, MASK_BITS), np.uint64),
        allocate_aligned_float64(capacity * ROWS // 2)
        .view(np.float32)
        .reshape((capacity // WIDTH, ROWS, WIDTH)),
        np.empty(capacity, np.int32),
        allocate_aligned_float64(capacity * COLOR_NORMAL_WORDS).reshape((capacity, COLOR_NORMAL_WORDS)),
        np.empty(capacity + WIDTH, np.uint64),
        np.empty(capacity + WIDTH, np.float32),
        np.empty(capacity + WIDTH, np.float32),
        np.empty(capacity + WIDTH, np.float32),
        np.empty(capacity + WIDTH, np.float32),
        np.empty(capacity + WIDTH, np.int32),
    )


@kernel()
def find_packet_starts(
    origins: Float32[np.ndarray, "#r 3"],
    directions: Float32[np.ndarray, "r 3"],
    max_rays: int,
    min_cosine: float,
    starts: Int64[np.ndarray, " r1"],
) -> int:
    """Find the first ray of each packet: neighbours in the array with one origin and similar directions.

    Returns the number of packets; ``starts`` has one more element than there are rays.
    """
    packets = 0
    first = 0
    one_origin = len(origins) == 1
    for r in range(len(directions)):
        if r > 0 and r - first < max_rays:
            cosine = (
                directions[r, 0] * directions[first, 0]
                + directions[r, 1] * directions[first, 1]
                + directions[r, 2] * directions[first, 2]
            )
            same = one_origin or (
                origins[r, 0] == origins[first, 0]
                and origins[r, 1] == origins[first, 1]
                # origins are compared to the bit: moments are only enough for one common origin
                and origins[r, 2] == origins[first, 2]
            )
            if same and cosine >= min_cosine:
                continue
        starts[packets] = r
        packets += 1
        first = r
    starts[packets] = len(directions)
    return packets


@device_function(error_model="numpy")
def find_candidates(
    rays: RayArrays,
    first: int,
    last: int,
    bvh: BvhArrays,
    frustum: Frustum,
    traversal: TraversalScratch,
    candidates: Candidates,
) -> tuple[Candidates, int]:
    """Find the candidates of the packet of rays ``first`` to ``last`` and return their count."""
    write_frustum(rays, first, last, frustum)
    # t_max of the packet: the largest of its rays
    one_end = len(rays.t_max) == 1
    farthest = rays.t_max[0 if one_end else first]
    if not one_end:
        for r in range(first + 1, last):
            farthest = max(farthest, rays.t_max[r])
    origin = ray_origin(rays, first)
    count = gather_candidates(bvh, frustum, origin, farthest, traversal, candidates)
    # Too many were found: only counted, and gathered again with room for all.
    if count > len(candidates.curve_indices):
        candidates = allocate_candidates((count * 5 // 4 + WIDTH - 1) // WIDTH * WIDTH)
        count = gather_candidates(bvh, frustum, origin, farthest, traversal, candidates)
    return candidates, count


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def write_in_packet_frame(
    block: Float32[np.ndarray, "12 lanes"],
    row: int,
    lane: int,
    frame: Float64[np.ndarray, "15"],
    x: float,
    y: float,
    z: float,
) -> None:
    """Write a vector along the axis, e and f of a packet's ``frame``, as three rows of a lane."""
    for axis in range(3):
        k = 3 * axis
        block[row + axis, lane] = np.float32(x * frame[k] + y * frame[k + 1] + z * frame[k + 2])


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def write_packet_primitive(
    block: Float32[np.ndarray, "12 lanes"],
    lane: int,
    primitive: Float32[np.ndarray, "16"],
    origin: tuple[float, float, float],
    frame: Float64[np.ndarray, "15"],
) -> None:
    """Write one Gaussian's row as a column of ``block``, for rays from one origin.

    Differences and rotations into the packet's ``frame`` are computed in float64, and only the results are
    rounded.
    """
    x, y, z = primitive[MEAN] - origin[0], primitive[MEAN + 1] - origin[1], primitive[MEAN + 2] - origin[2]
    n0, n1, n2 = primitive_vector(primitive, NORMAL)
    a0, a1, a2 = primitive_vector(primitive, AXIS_U)
    b0, b1, b2 = primitive_vector(primitive, AXIS_V)
    height = x * n0 + y * n1 + z * n2
    # Rows of u (N.d) = A.d and v (N.d) = B.d, from t = n0 / (N.d) and u = (t <d, r2> - <x, r2>) / s2
    xa = x * a0 + y * a1 + z * a2
    xb = x * b0 + y * b1 + z * b2
    write_in_packet_frame(block, N_X, lane, frame, n0, n1, n2)
    write_in_packet_frame(
        block, A_X, lane, frame, height * a0 - xa * n0, height * a1 - xa * n1, height * a2 - xa * n2
    )
    write_in_packet_frame(
        block, B_X, lane, frame, height * b0 - xb * n0, height * b1 - xb * n1, height * b2 - xb * n2
    )
    block[N_0, lane] = np.float32(height)
    block[INNER_RADIUS_ROW, lane] = primitive[INNER_RADIUS]
    block[ALPHA_0, lane] = primitive[OPACITY]


@njit_no_refcount(fastmath={"contract"})
def write_candidate_blocks(
    candidates: Candidates,
    count: int,
    scene: PackedScene,
    origin: tuple[float, float, float],
    frame: Float64[np.ndarray, "15"],
    prefetch_sh: bool,
) -> None:
    """Write the rows of the candidates for rays from one origin; the last block is padded with misses.

    Harmonics are asked for if hits will be ``prefetch_sh``.
    """
    rows, ids, records, sh = candidates.blocks, candidates.ids, scene.primitives, scene.sh
    records_at, sh_at = records.ctypes.data, sh.ctypes.data
    sh_bytes = sh.shape[1] * 12
    for k in range((count + WIDTH - 1) // WIDTH * WIDTH):
        if k + PREFETCH_DISTANCE < count:
            prefetch(records_at + ids[k + PREFETCH_DISTANCE] * PRIMITIVE_BYTES)
            if prefetch_sh:
                prefetch(sh_at + ids[k + PREFETCH_DISTANCE] * sh_bytes)
        block, lane = rows[k // WIDTH], k % WIDTH
        # padding that no ray hits: a plane across the axis and a negative radius
        if k >= count:
            for row in range(ROWS):
                block[row, lane] = np.float32(0.0)
            block[N_X, lane] = np.float32(1.0)
            block[INNER_RADIUS_ROW, lane] = np.float32(-1.0)
            continue
        write_packet_primitive(block, lane, records[ids[k]], origin, frame)
