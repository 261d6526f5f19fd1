"""Forward passes for packets: candidates once a packet, then each ray sorts and composites its own hits."""

import numpy as np
from numba import njit, prange

from engine.trace.cpu.bundles import Forward
from engine.trace.cpu.kernels_composite import Hit, begin, composite, finish
from engine.trace.cpu.kernels_packet import (
    ALPHA_0,
    CHUNK,
    N_X,
    START_ROOM,
    T_ROW,
    U_ROW,
    V_ROW,
    exponential,
    find_candidates,
    meet_blocks,
    new_candidates,
    new_pyramid,
    new_walk,
    write_rows,
)
from engine.trace.cpu.kernels_packet_order import keep_candidates, sort_candidates
from engine.trace.cpu.kernels_rays import ray_direction, ray_limits, ray_origin
from engine.trace.cpu.kernels_sh import write_basis
from engine.trace.cpu.kernels_simd import float32_bits, float32_from_bits, write_ranks
from engine.trace.cpu.kernels_tree import WIDTH
from engine.trace.kernels_native import lean, next_from_counter

RANKED = 96
"""Hits that are sorted by counting, for each, the smaller ones, eight at once: quadratic, but without a
branch that the processor could guess wrongly. The few longer lists take an insertion sort.
"""
STRIDE = CHUNK // WIDTH


@lean()
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


@lean()
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


@lean(forceinline=True, fastmath={"contract"})
def alpha_of(rows, block, lane, alpha_max):
    """Alpha of a candidate where the ray last tested meets it, rounded to float32."""
    u, v = rows[block, U_ROW, lane], rows[block, V_ROW, lane]
    power = -0.5 * (u * u + v * v)
    return np.float64(np.float32(min(rows[block, ALPHA_0, lane] * exponential(power), alpha_max)))


@lean(forceinline=True, fastmath={"contract"})
def trace_ray(r, bit, place, slots, forward, candidates, count, kept, memory):
    """Follow ray ``r``, which is ray ``bit`` of its packet; its hits are stored from ``place`` on.

    Returns the place behind its last hit, and the number of Gaussians that the packet has met, so far
    ``slots``, which ``kept`` lists from the place of the packet's first hit on.
    """
    basis, ranked, ranks, slot_base = memory
    rays, limits = forward.rays, forward.limits
    rows, ids, pending, slot_of = candidates.rows, candidates.ids, candidates.pending, candidates.slot_of
    direction = ray_direction(rays, r)
    t_min, t_max = ray_limits(rays, r)
    write_basis(basis, forward.scene.sh.shape[1], direction[0], direction[1], direction[2])
    front = begin(forward, r, place)
    block_count = (count + WIDTH - 1) // WIDTH
    head = tail = b0 = 0
    stop = False
    while b0 < block_count and not stop:
        b1 = min(b0 + STRIDE, block_count)
        n_met = meet_blocks(candidates, bit, b0, b1, direction)
        for m in range(n_met):
            k = candidates.met[m]
            t = np.float32(rows[k // WIDTH, T_ROW, k % WIDTH])
            if t <= t_min or t >= t_max:
                continue
            # distances are positive: their bits sort like their values
            pending[tail] = (np.uint64(float32_bits(t)) << np.uint64(32)) | np.uint64(k)
            tail += 1
        sort_pending(pending, ranked, ranks, head, tail)
        # What follows lies no nearer than this.
        nearest = candidates.near[min(b1 * WIDTH, count)]
        safe = np.uint64(float32_bits(nearest)) << np.uint64(32)
        while head < tail and pending[head] < safe:
            key = pending[head]
            if head + 1 < tail and pending[head + 1] >> np.uint64(32) == key >> np.uint64(32):
                order_ties(pending, head, tail, ids)
                key = pending[head]
            head += 1
            k = np.int64(key & np.uint64(0xFFFFFFFF))
            t = float32_from_bits(np.uint32(key >> np.uint64(32)))
            block, lane = k // WIDTH, k % WIDTH
            if forward.recording:
                if slot_of[k] < 0:
                    slot_of[k] = slots
                    kept.slot_ids[slot_base + slots] = ids[k]
                    slots += 1
                kept.slots[front.place] = slot_of[k]
                kept.us[front.place] = rows[block, U_ROW, lane]
                kept.vs[front.place] = rows[block, V_ROW, lane]
            hit = Hit(
                ids[k],
                t,
                alpha_of(rows, block, lane, limits.alpha_max),
                rows[block, N_X, lane],
                rows[block, N_X + 1, lane],
                rows[block, N_X + 2, lane],
            )
            front, stop = composite(front, hit, forward, r, direction, basis)
            if stop:
                break
        b0 = b1
        stop = stop or nearest >= t_max
    finish(front, forward, r)
    return front.place, slots


@njit(error_model="numpy")
def trace_from_counter(forward, packets, tree, kept, counter):
    """Trace packets of rays ``packets[p, 0]`` to ``packets[p, 1]`` until the ``counter`` has passed the last.

    Packet p's hits are stored from ``packets[p, 0] * max_hits`` on, and ``kept`` beside them. A ray's result
    depends on its packet alone, so it is the same for every number of threads.
    """
    pyramid, walk = new_pyramid(), new_walk()
    basis = np.empty(16, np.float64)
    ranked = np.empty(RANKED, np.uint64)
    ranks = np.empty(RANKED + WIDTH, np.int64)
    candidates = new_candidates(START_ROOM)
    while True:
        packet = next_from_counter(counter.ctypes.data)
        if packet >= len(packets):
            break
        first, last = packets[packet, 0], packets[packet, 1]
        candidates, count = find_candidates(forward.rays, first, last, tree, pyramid, walk, candidates)
        sort_candidates(candidates, count, tree.order, walk.histogram)
        write_rows(candidates, count, forward.scene, ray_origin(forward.rays, first), True)
        candidates.slot_of[:count] = -1
        slots = 0
        place = first * forward.limits.max_hits
        memory = basis, ranked, ranks, place
        for r in range(first, last):
            place, slots = trace_ray(r, r - first, place, slots, forward, candidates, count, kept, memory)
        if forward.recording:
            kept.slot_counts[packet] = slots


@njit(cache=True, parallel=True, error_model="numpy")
def trace_packets(rays, scene, limits, out, hits, recording, packets, tree, kept, workers, counter):
    """:func:`trace_from_counter` on ``workers`` threads; ``counter`` holds one zero.

    The first six are a :class:`Forward`, as a parallel loop takes no tuples of tuples.
    """
    for _worker in prange(workers):
        forward = Forward(rays, scene, limits, out, hits, recording)
        trace_from_counter(forward, packets, tree, kept, counter)


@lean(fastmath={"contract"})
def absorb_ray(r, bit, rays, candidates, count, limits):
    """What the candidates leave of ray ``r``, ray ``bit`` of its packet; 0 where that is below eps1."""
    rows = candidates.rows
    direction = ray_direction(rays, r)
    t_min, t_max = ray_limits(rays, r)
    block_count = (count + WIDTH - 1) // WIDTH
    left = 1.0
    for b0 in range(0, block_count, STRIDE):
        b1 = min(b0 + STRIDE, block_count)
        for m in range(meet_blocks(candidates, bit, b0, b1, direction)):
            k = candidates.met[m]
            block, lane = k // WIDTH, k % WIDTH
            t = np.float32(rows[block, T_ROW, lane])
            if t <= t_min or t >= t_max:
                continue
            left *= 1.0 - alpha_of(rows, block, lane, limits.alpha_max)
            if left < limits.eps1:
                return 0.0
    return left


@njit(error_model="numpy")
def absorb_from_counter(rays, scene, limits, packets, tree, counter, transmittance):
    """The transmittance of rays alone: nothing is sorted, no colour is read."""
    pyramid, walk = new_pyramid(), new_walk()
    candidates = new_candidates(START_ROOM)
    while True:
        packet = next_from_counter(counter.ctypes.data)
        if packet >= len(packets):
            break
        first, last = packets[packet, 0], packets[packet, 1]
        candidates, count = find_candidates(rays, first, last, tree, pyramid, walk, candidates)
        keep_candidates(candidates, count, tree.order)
        write_rows(candidates, count, scene, ray_origin(rays, first), False)
        for r in range(first, last):
            transmittance[r] = absorb_ray(r, r - first, rays, candidates, count, limits)


@njit(cache=True, parallel=True, error_model="numpy")
def absorb_packets(rays, scene, limits, packets, tree, workers, counter, transmittance):
    """:func:`absorb_from_counter` on ``workers`` threads; ``counter`` holds one zero."""
    for _worker in prange(workers):
        absorb_from_counter(rays, scene, limits, packets, tree, counter, transmittance)
