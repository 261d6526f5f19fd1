"""Packets of rays with one origin: who shares one, which Gaussians may it meet, and their rows for SIMD.

A packet's rays fill a pyramid. The hierarchy is walked once for the pyramid; the Gaussians whose ellipse
reaches into it are the packet's candidates, ordered by the least distance at which a ray of it can meet
them.
"""

import math

import numpy as np
from numba import njit

from engine.trace.kernels_hit import AXIS_U, AXIS_V, INNER_RADIUS, MEAN, NORMAL, OPACITY, RECORD_WORDS
from engine.trace.kernels_simd import (
    boxes_in_pyramid,
    ellipses_in_pyramid,
    float32_bits,
    float64_from_bits,
    lowest_bit,
    meet_block,
    prefetch,
)
from engine.trace.kernels_tree import BOX_ROWS, LEAF_ROWS, WIDTH

STACK = 1024
# --- rows of a block of eight candidates, float64; u (N.d) = A.d and v (N.d) = B.d, t (N.d) = n0 ---
N_X, A_X, B_X, N_0, INNER, ALPHA_0, T_ROW, U_ROW, V_ROW, OUTSIDE = 0, 3, 6, 9, 10, 11, 12, 13, 14, 15
ROWS = 16
ROW_BYTES, NODE_BYTES, BLOCK_BYTES = ROWS * WIDTH * 8, BOX_ROWS * WIDTH * 4, LEAF_ROWS * WIDTH * 4
AHEAD = 8
"""Candidates between asking for a record and reading it."""
RECORD_BYTES = RECORD_WORDS * 4
SIDES = 5
"""Planes of a pyramid: four through its sides, one through its apex across the axis."""


@njit(cache=True)
def packet_starts(origins, directions, most, least_cosine, starts):
    """First ray of each packet: neighbours in the array that share an origin and look about one way.

    Returns the number of packets; ``starts`` has room for one more than there are rays.
    """
    packets = 0
    first = 0
    for r in range(len(origins)):
        if r > 0 and r - first < most:
            cosine = (
                directions[r, 0] * directions[first, 0]
                + directions[r, 1] * directions[first, 1]
                + directions[r, 2] * directions[first, 2]
            )
            same = (
                origins[r, 0] == origins[first, 0]
                and origins[r, 1] == origins[first, 1]
                and origins[r, 2] == origins[first, 2]
            )
            if same and cosine >= least_cosine:
                continue
        starts[packets] = r
        packets += 1
        first = r
    starts[packets] = len(origins)
    return packets


@njit(error_model="numpy")
def make_pyramid(directions, first, last, planes):
    """Inward normals of the pyramid around rays ``first`` to ``last``, and its axis as the fifth plane.

    Returns the four slopes (a low, a high, b low, b high) along the axes e1, e2, and writes axis, e1, e2 to
    rows 4, 5 and 6 of ``planes``.
    """
    x = y = z = 0.0
    for r in range(first, last):
        x += directions[r, 0]
        y += directions[r, 1]
        z += directions[r, 2]
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = x * scale, y * scale, z * scale
    # any frame around the axis
    if abs(x) < 0.6:
        e0, e1, e2 = 0.0, z, -y
    else:
        e0, e1, e2 = -z, 0.0, x
    scale = 1.0 / math.sqrt(e0 * e0 + e1 * e1 + e2 * e2)
    e0, e1, e2 = e0 * scale, e1 * scale, e2 * scale
    f0, f1, f2 = y * e2 - z * e1, z * e0 - x * e2, x * e1 - y * e0
    a_low = b_low = np.inf
    a_high = b_high = -np.inf
    for r in range(first, last):
        d0, d1, d2 = np.float64(directions[r, 0]), np.float64(directions[r, 1]), np.float64(directions[r, 2])
        inverse = 1.0 / (d0 * x + d1 * y + d2 * z)
        a = (d0 * e0 + d1 * e1 + d2 * e2) * inverse
        b = (d0 * f0 + d1 * f1 + d2 * f2) * inverse
        a_low, a_high, b_low, b_high = min(a_low, a), max(a_high, a), min(b_low, b), max(b_high, b)
    room = 1e-9
    a_low, a_high, b_low, b_high = a_low - room, a_high + room, b_low - room, b_high + room
    planes[0, 0], planes[0, 1], planes[0, 2] = e0 - a_low * x, e1 - a_low * y, e2 - a_low * z
    planes[1, 0], planes[1, 1], planes[1, 2] = a_high * x - e0, a_high * y - e1, a_high * z - e2
    planes[2, 0], planes[2, 1], planes[2, 2] = f0 - b_low * x, f1 - b_low * y, f2 - b_low * z
    planes[3, 0], planes[3, 1], planes[3, 2] = b_high * x - f0, b_high * y - f1, b_high * z - f2
    planes[4, 0], planes[4, 1], planes[4, 2] = x, y, z
    rows = planes.view(np.int64)
    for side in range(SIDES):
        for axis in range(3):
            rows[side, 3 + axis] = 3 + axis if planes[side, axis] > 0.0 else axis
    planes[5, 0], planes[5, 1], planes[5, 2] = e0, e1, e2
    planes[6, 0], planes[6, 1], planes[6, 2] = f0, f1, f2
    return a_low, a_high, b_low, b_high


@njit(fastmath={"contract"}, error_model="numpy")
def gather_candidates(nodes, level_starts, blocks, count, planes, ox, oy, oz, stack, found):
    """Curve places of the Gaussians whose ellipse reaches into the pyramid; returns how many there are.

    Only as many as fit are written to ``found``.
    """
    n_found = 0
    top = len(level_starts) - 2
    stack[0] = level_starts[top]
    stack[1] = top
    depth = 1
    room = len(found)
    nodes_at, blocks_at, planes_at = nodes.ctypes.data, blocks.ctypes.data, planes.ctypes.data
    while depth > 0:
        depth -= 1
        node = stack[2 * depth]
        level = stack[2 * depth + 1]
        mask = boxes_in_pyramid(nodes_at + node * NODE_BYTES, planes_at, ox, oy, oz)
        first_child = (node - level_starts[level]) * WIDTH
        while mask != 0:
            child = first_child + lowest_bit(mask)
            mask &= mask - 1
            if level > 0:
                stack[2 * depth] = level_starts[level - 1] + child
                stack[2 * depth + 1] = level - 1
                depth += 1
                continue
            reached = ellipses_in_pyramid(blocks_at + child * BLOCK_BYTES, planes_at, ox, oy, oz)
            while reached != 0:
                place = child * WIDTH + lowest_bit(reached)
                reached &= reached - 1
                if place < count:
                    if n_found < room:
                        found[n_found] = place
                    n_found += 1
    return n_found


@njit(fastmath={"contract"}, error_model="numpy")
def sort_by_least_distance(
    found, count, blocks, order, planes, slopes, ox, oy, oz, keys, scratch, histogram, bounds, ids, near
):
    """Ids of the candidates by the least distance at which a ray of the packet can meet them."""
    ax, ay, az = planes[4, 0], planes[4, 1], planes[4, 2]
    for k in range(count):
        place = found[k]
        block = place // WIDTH
        lane = place % WIDTH
        m0, m1, m2 = blocks[block, 0, lane] - ox, blocks[block, 1, lane] - oy, blocks[block, 2, lane] - oz
        u = blocks[block, 3, lane] * ax + blocks[block, 4, lane] * ay + blocks[block, 5, lane] * az
        v = blocks[block, 6, lane] * ax + blocks[block, 7, lane] * ay + blocks[block, 8, lane] * az
        middle = m0 * ax + m1 * ay + m2 * az
        reach = math.sqrt(u * u + v * v)
        least = middle - reach
        # The plane's depth along the axis is largest and least at the pyramid's edges, if it meets all four.
        u0, u1, u2 = (
            np.float64(blocks[block, 3, lane]),
            np.float64(blocks[block, 4, lane]),
            np.float64(blocks[block, 5, lane]),
        )
        v0, v1, v2 = (
            np.float64(blocks[block, 6, lane]),
            np.float64(blocks[block, 7, lane]),
            np.float64(blocks[block, 8, lane]),
        )
        n0, n1, n2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        height = m0 * n0 + m1 * n1 + m2 * n2
        on_axis = ax * n0 + ay * n1 + az * n2
        on_e = planes[5, 0] * n0 + planes[5, 1] * n1 + planes[5, 2] * n2
        on_f = planes[6, 0] * n0 + planes[6, 1] * n1 + planes[6, 2] * n2
        if height < 0.0:
            height, on_axis, on_e, on_f = -height, -on_axis, -on_e, -on_f
        steepest = on_axis + max(slopes[0] * on_e, slopes[1] * on_e) + max(slopes[2] * on_f, slopes[3] * on_f)
        if steepest > 0.0:
            least = max(least, height / steepest)
        # Most rays meet it about where the axis does.
        likely = height / on_axis if on_axis > 0.0 else middle
        likely = max(min(max(likely, middle - reach), middle + reach), 0.0)
        bounds[k] = max(least * (1.0 - 1e-6), 0.0)
        # non-negative floats sort like their bits
        keys[k] = (np.uint64(float32_bits(np.float32(likely))) << np.uint64(32)) | np.uint64(k)
    if count > 48:
        sort_keys(keys, scratch, count, histogram)
    else:
        insertion_sort(keys, count)
    nearest = np.float32(np.inf)
    near[count] = nearest
    for k in range(count - 1, -1, -1):
        which = np.int64(keys[k] & np.uint64(0xFFFFFFFF))
        ids[k] = order[found[which]]
        nearest = min(nearest, bounds[which])
        near[k] = nearest


@njit
def insertion_sort(keys, count):
    """Sort a few keys in place."""
    for i in range(1, count):
        key = keys[i]
        j = i
        while j > 0 and keys[j - 1] > key:
            keys[j] = keys[j - 1]
            j -= 1
        keys[j] = key


@njit
def sort_keys(keys, scratch, count, histogram):
    """Sort in place by the upper bits of the keys' distances, then by the rest.

    Two passes over the 16 bits below the distances' common upper bits leave so little disorder that the
    insertion sort afterwards hardly moves anything.
    """
    low, high = keys[0], keys[0]
    for k in range(1, count):
        low, high = min(low, keys[k]), max(high, keys[k])
    low, high = low >> np.uint64(32), high >> np.uint64(32)
    shift = np.uint64(32)
    span = high - low
    while span >= np.uint64(1 << 16):
        span >>= np.uint64(1)
        shift += np.uint64(1)
    low <<= np.uint64(32)
    for digit in range(2):
        histogram[:] = 0
        at = shift + np.uint64(8 * digit)
        for k in range(count):
            histogram[((keys[k] - low) >> at) & np.uint64(255)] += 1
        total = 0
        for b in range(256):
            size = histogram[b]
            histogram[b] = total
            total += size
        for k in range(count):
            bucket = ((keys[k] - low) >> at) & np.uint64(255)
            scratch[histogram[bucket]] = keys[k]
            histogram[bucket] += 1
        keys, scratch = scratch, keys
    insertion_sort(keys, count)


@njit(fastmath={"contract"}, error_model="numpy")
def write_rows(rows, ids, count, records, sh, ox, oy, oz):
    """Rows of the candidates for rays from one origin; the last block is filled with lanes that never hit."""
    records_at, sh_at = records.ctypes.data, sh.ctypes.data
    sh_bytes = sh.shape[1] * 12
    for k in range((count + WIDTH - 1) // WIDTH * WIDTH):
        if k + AHEAD < count:
            prefetch(records_at + ids[k + AHEAD] * RECORD_BYTES)
            prefetch(sh_at + ids[k + AHEAD] * sh_bytes)
        block, lane = rows[k // WIDTH], k % WIDTH
        if k >= count:
            for row in range(ROWS):
                block[row, lane] = 0.0
            block[N_X, lane] = 1.0
            block[INNER, lane] = -1.0
            continue
        record = records[ids[k]]
        x, y, z = record[MEAN] - ox, record[MEAN + 1] - oy, record[MEAN + 2] - oz
        n0, n1, n2 = (
            np.float64(record[NORMAL]),
            np.float64(record[NORMAL + 1]),
            np.float64(record[NORMAL + 2]),
        )
        a0, a1, a2 = (
            np.float64(record[AXIS_U]),
            np.float64(record[AXIS_U + 1]),
            np.float64(record[AXIS_U + 2]),
        )
        b0, b1, b2 = (
            np.float64(record[AXIS_V]),
            np.float64(record[AXIS_V + 1]),
            np.float64(record[AXIS_V + 2]),
        )
        height = x * n0 + y * n1 + z * n2
        xa = x * a0 + y * a1 + z * a2
        xb = x * b0 + y * b1 + z * b2
        block[N_X, lane], block[N_X + 1, lane], block[N_X + 2, lane] = n0, n1, n2
        block[A_X, lane] = height * a0 - xa * n0
        block[A_X + 1, lane] = height * a1 - xa * n1
        block[A_X + 2, lane] = height * a2 - xa * n2
        block[B_X, lane] = height * b0 - xb * n0
        block[B_X + 1, lane] = height * b1 - xb * n1
        block[B_X + 2, lane] = height * b2 - xb * n2
        block[N_0, lane] = height
        block[INNER, lane] = record[INNER_RADIUS]
        block[ALPHA_0, lane] = record[OPACITY]


@njit(fastmath={"contract"}, error_model="numpy")
def meet_blocks(rows, first, last, dx, dy, dz, met):
    """Candidates of blocks ``first`` to ``last`` whose octagon the ray meets; returns how many.

    Leaves t, u and v of each in the rows.
    """
    count = 0
    rows_at = rows.ctypes.data
    for b in range(first, last):
        mask = meet_block(rows_at + b * ROW_BYTES, dx, dy, dz)
        while mask != 0:
            met[count] = b * WIDTH + lowest_bit(mask)
            mask &= mask - 1
            count += 1
    return count


@njit(fastmath={"contract"}, error_model="numpy")
def exponential(x):
    """exp(x) for |x| < 700 to a relative 1e-8."""
    n = math.floor(x * 1.4426950408889634 + 0.5)
    r = x - n * 0.6931471805599453
    p = 1.0 / 5040.0 + r * (1.0 / 40320.0)
    p = 1.0 / 720.0 + r * p
    p = 1.0 / 120.0 + r * p
    p = 1.0 / 24.0 + r * p
    p = 1.0 / 6.0 + r * p
    p = 0.5 + r * p
    p = 1.0 + r * p
    p = 1.0 + r * p
    return p * float64_from_bits((np.int64(n) + 1023) << 52)
