"""The forward pass for packets: candidates once a packet, then each ray sorts and composites its own hits."""

import numpy as np
from numba import njit, prange

from engine.trace.cpu.kernels_footprint import BINS, FRAME_WORDS
from engine.trace.cpu.kernels_packet import (
    ALPHA_0,
    CHUNK,
    ROWS,
    SIDES,
    STACK,
    T_ROW,
    U_ROW,
    V_ROW,
    exponential,
    gather_candidates,
    make_pyramid,
    meet_blocks,
    sort_candidates,
    write_rows,
)
from engine.trace.cpu.kernels_sh import write_basis
from engine.trace.cpu.kernels_simd import float32_bits, float32_from_bits, write_ranks
from engine.trace.cpu.kernels_tree import WIDTH
from engine.trace.kernels_native import next_from_counter

RANKED = 96
STRIDE = CHUNK // WIDTH


@njit(error_model="numpy")
def sort_pending(pending, ranked, ranks, first, last):
    """Sort keys ``first`` to ``last``, all different; a few by counting the smaller ones."""
    count = last - first
    if count > RANKED:
        for i in range(first + 1, last):
            key = pending[i]
            j = i
            while j > first and pending[j - 1] > key:
                pending[j] = pending[j - 1]
                j -= 1
            pending[j] = key
        return
    base = pending.ctypes.data + first * 8
    for i in range(0, count, WIDTH):
        write_ranks(base, i, count, ranks.ctypes.data)
    for i in range(count):
        ranked[ranks[i]] = pending[first + i]
    for i in range(count):
        pending[first + i] = ranked[i]


@njit(error_model="numpy")
def order_ties(pending, head, tail, ids):
    """Order the hits that share the distance of the one at ``head`` by id."""
    distance = pending[head] >> np.uint64(32)
    for i in range(head + 1, tail):
        key = pending[i]
        if key >> np.uint64(32) != distance:
            break
        j = i
        while (
            j > head
            and ids[np.int64(pending[j - 1] & np.uint64(0xFFFFFFFF))]
            > ids[np.int64(key & np.uint64(0xFFFFFFFF))]
        ):
            pending[j] = pending[j - 1]
            j -= 1
        pending[j] = key


@njit(error_model="numpy")
def candidate_arrays(room):
    """Room for so many candidates, a multiple of eight: as they were found, in order, and of one ray."""
    return (
        np.empty(room, np.int32),  # found
        np.empty(room, np.uint64),  # keys
        np.empty(room, np.int32),  # ids
        np.empty(room + 1, np.float32),  # near
        np.empty(room, np.float32),  # bounds
        np.empty(room, np.int32),  # cells
        np.empty(room, np.uint64),  # masks
        np.empty(room // WIDTH, np.uint64),  # block_rays
        np.empty((room // WIDTH, ROWS, WIDTH), np.float64),  # rows
        np.empty(room, np.int32),  # slot_of
        np.empty(room + WIDTH, np.int32),  # met
        np.empty(room + WIDTH, np.uint64),  # pending
    )


@njit(fastmath={"contract"}, error_model="numpy")
def trace_from_counter(
    origins, directions, packets, nodes, level_starts, blocks, order, records, sh, features, eps1, eps2,
    t_min, alpha_max, max_hits, counter, rgb, transmittance, depth_sum, depth_median, normal_sum,
    feature_sum, counts, record_hits, starts, hit_ids, hit_alphas, hit_ts, hit_rgb, hit_us, hit_vs,
    hit_slots, slot_ids, slot_counts,
):  # fmt: skip
    """Trace packets of rays ``packets[p]`` to ``packets[p + 1]``.

    Packet p's hits are stored from packets[p] * max_hits on.

    ``eps2`` > 1 means the single-threshold stop. A ray's result depends on its packet alone, so it is the
    same for every number of threads. ``counter`` holds one zero.
    """
    packet_count = len(packets) - 1
    basis_count = sh.shape[1]
    feature_count = features.shape[1]
    near_limit = np.float32(t_min)
    basis = np.empty(16, np.float64)
    planes = np.empty((SIDES, 6), np.float64)
    frame = np.empty(FRAME_WORDS, np.float64)
    bins = np.empty((4, WIDTH), np.int32)
    distances = np.empty((2, WIDTH), np.float64)
    below = np.empty((2, BINS + 1), np.uint64)
    stack = np.empty(STACK, np.int64)
    histogram = np.empty(256, np.int32)
    ranked = np.empty(RANKED, np.uint64)
    ranks = np.empty(RANKED + WIDTH, np.int64)
    room = 512
    (
        found, keys, ids, near, bounds, cells, masks, block_rays, rows, slot_of, met, pending,
    ) = candidate_arrays(room)  # fmt: skip
    while True:
        packet = next_from_counter(counter.ctypes.data)
        if packet >= packet_count:
            break
        first, last = packets[packet], packets[packet + 1]
        ox, oy, oz = (
            np.float64(origins[first, 0]),
            np.float64(origins[first, 1]),
            np.float64(origins[first, 2]),
        )
        make_pyramid(directions, first, last, planes, frame, below)
        count = gather_candidates(
            nodes, level_starts, blocks, len(order), planes, frame, below, ox, oy, oz, stack, bins, distances,
            found, keys, bounds, cells, masks,
        )  # fmt: skip
        if count > room:
            room = (count * 5 // 4 + WIDTH - 1) // WIDTH * WIDTH
            (
                found, keys, ids, near, bounds, cells, masks, block_rays, rows, slot_of, met, pending,
            ) = candidate_arrays(room)  # fmt: skip
            count = gather_candidates(
                nodes, level_starts, blocks, len(order), planes, frame, below, ox, oy, oz, stack, bins,
                distances, found, keys, bounds, cells, masks,
            )  # fmt: skip
        sort_candidates(
            found, count, order, keys, pending, histogram, bounds, cells, masks, ids, near, block_rays
        )
        write_rows(rows, ids, count, records, sh, ox, oy, oz)
        block_count = (count + WIDTH - 1) // WIDTH
        for k in range(count):
            slot_of[k] = -1
        slots = 0
        position = slot_base = first * max_hits
        for r in range(first, last):
            dx, dy, dz = (
                np.float64(directions[r, 0]),
                np.float64(directions[r, 1]),
                np.float64(directions[r, 2]),
            )
            write_basis(basis, basis_count, dx, dy, dz)
            t1, t2 = 1.0, 1.0
            second_phase = False
            red = green = blue = depth = 0.0
            normal_x = normal_y = normal_z = 0.0
            median = np.float32(0.0)
            for f in range(feature_count):
                feature_sum[r, f] = 0.0
            hits = 0
            starts[r] = position
            head = tail = 0
            stop = False
            b0 = 0
            while b0 < block_count and not stop:
                b1 = min(b0 + STRIDE, block_count)
                n_met = meet_blocks(rows, block_rays, r - first, b0, b1, dx, dy, dz, met)
                for m in range(n_met):
                    k = met[m]
                    t = np.float32(rows[k // WIDTH, T_ROW, k % WIDTH])
                    if t <= near_limit:
                        continue
                    # distances are positive: their bits sort like their values
                    key = (np.uint64(float32_bits(t)) << np.uint64(32)) | np.uint64(k)
                    pending[tail] = key
                    tail += 1
                sort_pending(pending, ranked, ranks, head, tail)
                # What follows lies no nearer than this.
                safe = np.uint64(float32_bits(near[min(b1 * WIDTH, count)])) << np.uint64(32)
                while head < tail and pending[head] < safe:
                    key = pending[head]
                    if head + 1 < tail and pending[head + 1] >> np.uint64(32) == key >> np.uint64(32):
                        order_ties(pending, head, tail, ids)
                        key = pending[head]
                    head += 1
                    k = np.int64(key & np.uint64(0xFFFFFFFF))
                    t = float32_from_bits(np.uint32(key >> np.uint64(32)))
                    block, lane = k // WIDTH, k % WIDTH
                    u, v = rows[block, U_ROW, lane], rows[block, V_ROW, lane]
                    power = -0.5 * (u * u + v * v)
                    alpha = np.float64(
                        np.float32(min(rows[block, ALPHA_0, lane] * exponential(power), alpha_max))
                    )
                    i = ids[k]
                    weight = alpha * t1
                    c_red = c_green = c_blue = 0.5
                    for j in range(basis_count):
                        c_red += sh[i, j, 0] * basis[j]
                        c_green += sh[i, j, 1] * basis[j]
                        c_blue += sh[i, j, 2] * basis[j]
                    c_red, c_green, c_blue = max(c_red, 0.0), max(c_green, 0.0), max(c_blue, 0.0)
                    red += weight * c_red
                    green += weight * c_green
                    blue += weight * c_blue
                    depth += weight * t
                    n_x, n_y, n_z = rows[block, 0, lane], rows[block, 1, lane], rows[block, 2, lane]
                    facing = -weight if dx * n_x + dy * n_y + dz * n_z > 0.0 else weight
                    normal_x += facing * n_x
                    normal_y += facing * n_y
                    normal_z += facing * n_z
                    for f in range(feature_count):
                        feature_sum[r, f] += np.float32(weight * features[i, f])
                    if t1 > 0.5 and t1 * (1.0 - alpha) <= 0.5:
                        median = t
                    if record_hits:
                        slot = slot_of[k]
                        if slot < 0:
                            slot = slots
                            slot_of[k] = slot
                            slot_ids[slot_base + slot] = i
                            slots += 1
                        hit_slots[position] = slot
                        hit_ids[position] = i
                        hit_alphas[position] = np.float32(alpha)
                        hit_ts[position] = t
                        hit_us[position] = u
                        hit_vs[position] = v
                        hit_rgb[position, 0] = c_red
                        hit_rgb[position, 1] = c_green
                        hit_rgb[position, 2] = c_blue
                        position += 1
                    hits += 1
                    t1 *= 1.0 - alpha
                    if second_phase:
                        t2 *= 1.0 - alpha
                    elif t1 < eps1:
                        second_phase = True
                    if (second_phase and t2 < eps2) or hits >= max_hits:
                        stop = True
                        break
                b0 = b1
            counts[r] = hits
            rgb[r, 0], rgb[r, 1], rgb[r, 2] = red, green, blue
            transmittance[r] = t1
            depth_sum[r] = depth
            depth_median[r] = median
            normal_sum[r, 0], normal_sum[r, 1], normal_sum[r, 2] = normal_x, normal_y, normal_z
        if record_hits:
            slot_counts[packet] = slots


@njit(cache=True, parallel=True, error_model="numpy")
def trace_packets(
    origins, directions, packets, nodes, level_starts, blocks, order, records, sh, features, eps1, eps2,
    t_min, alpha_max, max_hits, workers, counter, rgb, transmittance, depth_sum, depth_median, normal_sum,
    feature_sum, counts, record_hits, starts, hit_ids, hit_alphas, hit_ts, hit_rgb, hit_us, hit_vs,
    hit_slots, slot_ids, slot_counts,
):  # fmt: skip
    """:func:`trace_from_counter` on ``workers`` threads."""
    for _worker in prange(workers):
        trace_from_counter(
            origins, directions, packets, nodes, level_starts, blocks, order, records, sh,
            features, eps1, eps2, t_min, alpha_max, max_hits, counter, rgb, transmittance,
            depth_sum, depth_median, normal_sum, feature_sum, counts, record_hits, starts,
            hit_ids, hit_alphas, hit_ts, hit_rgb, hit_us, hit_vs, hit_slots, slot_ids,
            slot_counts,
        )  # fmt: skip
