"""Forward passes for packets: candidates once a packet, then each ray sorts and composites its own hits."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt64

from octasplat.engine.compilation import device_function, kernel
from octasplat.engine.trace.cpu.kernels_eight import (
    add_shown,
    keep_hits,
    know_slots,
    meet_block,
    sort_few,
    weigh_next,
    write_alphas,
)
from octasplat.engine.trace.cpu.kernels_hit import MEAN, NORMAL
from octasplat.engine.trace.cpu.kernels_packet import (
    CHUNK,
    RECORD_BYTES,
    ROW_BYTES,
    SHOWN,
    START_ROOM,
    WORD,
    find_candidates,
    new_candidates,
    write_rows,
)
from octasplat.engine.trace.cpu.kernels_packet_order import keep_candidates, sort_candidates
from octasplat.engine.trace.cpu.kernels_packet_walk import new_pyramid, new_walk
from octasplat.engine.trace.cpu.kernels_rays import (
    first_place,
    ray_limits,
    ray_origin,
    ray_slopes,
    record_vector,
    side_shown,
)
from octasplat.engine.trace.cpu.kernels_sh import colour, write_view
from octasplat.engine.trace.cpu.kernels_simd import float32_bits, float32_from_bits, lowest_bit
from octasplat.engine.trace.cpu.kernels_tree import WIDTH
from octasplat.engine.trace.kernels_native import ask_for, lean, next_from_counter, prefetch

RANKED = 96
"""Hits that are sorted by counting, for each, the smaller ones, eight at once: quadratic, but without a
branch that the processor could guess wrongly. The few longer lists take an insertion sort.
"""
STRIDE = CHUNK // WIDTH
STRIDE_BITS = np.uint64((1 << STRIDE) - 1)
LOWER = np.uint64(0xFFFFFFFF)
UPPER = np.uint64(32)


class Scratch(NamedTuple):
    """Memory of a thread: harmonics, keys that are sorted, sums of a ray, and eight hits."""

    basis: Float64[np.ndarray, "16"]
    ranked: UInt64[np.ndarray, "104"]
    sums: Float64[np.ndarray, "8"]
    alphas: Float32[np.ndarray, "8"]
    weights: Float64[np.ndarray, "8"]
    after: Float64[np.ndarray, "8"]
    depths: Float64[np.ndarray, "8"]
    numbers: Int64[np.ndarray, "8"]
    slots: Int64[np.ndarray, "8"]


@device_function(error_model="numpy")
def new_scratch():
    """Memory for rays, one after another."""
    return Scratch(
        np.empty(16, np.float64),
        np.empty(RANKED + WIDTH, np.uint64),
        np.empty(SHOWN, np.float64),
        np.empty(WIDTH, np.float32),
        np.empty(WIDTH, np.float64),
        np.empty(WIDTH, np.float64),
        np.empty(WIDTH, np.float64),
        np.empty(WIDTH, np.int64),
        np.empty(WIDTH, np.int64),
    )


@lean()
def order_ties(candidates, head, tail):
    """Order the hits ``head`` to ``tail``, which are sorted by distance, by id where they share one."""
    pending, numbers, ids = candidates.pending, candidates.numbers, candidates.ids
    for i in range(head + 1, tail):
        key = pending[i]
        if key >> UPPER != pending[i - 1] >> UPPER:
            continue
        mine = ids[numbers[np.int64(key & LOWER)]]
        j = i
        while (
            j > head
            and pending[j - 1] >> UPPER == key >> UPPER
            and ids[numbers[np.int64(pending[j - 1] & LOWER)]] > mine
        ):
            pending[j] = pending[j - 1]
            j -= 1
        pending[j] = key


@lean()
def sort_pending(candidates, ranked, head, tail):
    """Sort the hits ``head`` to ``tail`` of a ray by distance, and by id where they share one."""
    if tail - head <= RANKED:
        if sort_few(candidates.pending.ctypes.data + head * 8, tail - head, ranked.ctypes.data):
            order_ties(candidates, head, tail)
        return
    pending = candidates.pending
    for i in range(head + 1, tail):
        key = pending[i]
        j = i
        while j > head and pending[j - 1] > key:
            pending[j] = pending[j - 1]
            j -= 1
        pending[j] = key
    order_ties(candidates, head, tail)


@lean(forceinline=True)
def meet_blocks(candidates, bit, first, slopes, limits, tail):
    """Test the ``STRIDE`` blocks from ``first`` on that the packet's ray ``bit`` may meet.

    Returns how many hits there are then; ``tail`` are known already. The blocks' bits lie in one word.
    """
    a, b, per_axis = np.float32(slopes[0]), np.float32(slopes[1]), np.float32(slopes[2])
    t_min, t_max = limits
    c = candidates
    rows_at = c.rows.ctypes.data
    bits = (c.ray_blocks[first // WORD, bit] >> np.uint64(first % WORD)) & STRIDE_BITS
    bits = np.int64(bits)
    while bits != 0:
        block = first + lowest_bit(bits)
        bits &= bits - 1
        tail += meet_block(
            rows_at + block * ROW_BYTES, a, b, per_axis, t_min, t_max, block * WIDTH, tail,
            c.pending.ctypes.data, c.alphas.ctypes.data, c.opacities.ctypes.data, c.us.ctypes.data,
            c.vs.ctypes.data, c.numbers.ctypes.data,
        )  # fmt: skip
    return tail


@lean(forceinline=True)
def know_alphas(candidates, first, last, alpha_max):
    """Alphas of the hits ``first`` to ``last`` of a ray."""
    for place in range(first, last, WIDTH):
        write_alphas(
            candidates.alphas.ctypes.data, candidates.opacities.ctypes.data, place, np.float32(alpha_max)
        )


@lean(forceinline=True)
def ask_for_colours(new, numbers, ids, scene):
    """Ask for what the hits ``new`` show at once, so that memory is not waited for one by one."""
    sh_at, sh_bytes = scene.sh.ctypes.data, scene.sh.shape[1] * 12
    while new != 0:
        i = ids[numbers[lowest_bit(new)]]
        prefetch(scene.records.ctypes.data + i * RECORD_BYTES)
        ask_for(sh_at + i * sh_bytes, sh_bytes)
        new &= new - 1


@lean(fastmath={"contract"})
def show(shown, i, scene, limits, origin, basis):
    """What Gaussian ``i`` shows to rays from ``origin``."""
    record = scene.records[i]
    x, y, z = record[MEAN] - origin[0], record[MEAN + 1] - origin[1], record[MEAN + 2] - origin[2]
    n0, n1, n2 = record_vector(record, NORMAL)
    write_view(basis, scene.sh.shape[1], x, y, z)
    shown[0], shown[1], shown[2] = colour(scene.sh, i, basis)
    shown[3] = shown[7] = 0.0
    side = side_shown((x, y, z), (n0, n1, n2), limits)
    shown[4], shown[5], shown[6] = side * n0, side * n1, side * n2


@lean(fastmath={"contract"})
def trace_ray(r, bit, place, slots, slot_base, origin, frame, forward, candidates, count, kept, scratch):
    """Follow ray ``r``, which is ray ``bit`` of its packet; its hits are stored from ``place`` on.

    Returns the place behind its last hit, and the number of Gaussians that the packet has met, so far
    ``slots``, which ``kept`` lists from ``slot_base`` on.
    """
    limits, hits, out, features = forward.limits, forward.hits, forward.out, forward.scene.features
    pending, ids = candidates.pending, candidates.ids
    slot_of, shown = candidates.slot_of, candidates.shown
    feature_count, recording = features.shape[1], forward.recording
    slopes, span = ray_slopes(forward.rays, r, frame), ray_limits(forward.rays, r)
    if recording:
        hits.starts[r] = place
    scratch.sums[:] = 0.0
    scratch.depths[:] = 0.0
    for f in range(feature_count):
        out.features[r, f] = np.float32(0.0)
    # The second phase begins where too little is left, and ends where its own part of it is (Algorithm 1).
    t, stop_below, last_phase = 1.0, limits.eps1, limits.eps2 > 1.0
    median = np.float32(0.0)
    found = head = tail = b0 = 0
    block_count = (count + WIDTH - 1) // WIDTH
    stop = False
    while b0 < block_count and not stop:
        b1 = min(b0 + STRIDE, block_count)
        known = tail
        tail = meet_blocks(candidates, bit, b0, slopes, span, tail)
        if tail > known:
            know_alphas(candidates, known, tail, limits.alpha_max)
            sort_pending(candidates, scratch.ranked, head, tail)
        # What follows lies no nearer than this.
        nearest = candidates.near[min(b1 * WIDTH, count)]
        safe = np.uint64(float32_bits(nearest)) << UPPER
        while not stop and head < tail and pending[head] < safe:
            keys_at = pending.ctypes.data + head * 8
            bits = weigh_next(
                keys_at, min(tail - head, limits.max_hits - found), safe, candidates.alphas.ctypes.data, t,
                stop_below, scratch.alphas.ctypes.data, scratch.weights.ctypes.data,
                scratch.after.ctypes.data,
            )  # fmt: skip
            taken = n = bits >> (2 * WIDTH)
            if bits & ((1 << n) - 1) != 0:
                last = lowest_bit(bits)
                if not last_phase:
                    last_phase = True
                    stop_below = scratch.after[last] * limits.eps2
                    last += 1
                    while last < n and scratch.after[last] >= stop_below:
                        last += 1
                if last < n:
                    taken, stop = last + 1, True
            if t > 0.5:
                halves = (bits >> WIDTH) & ((1 << taken) - 1)
                if halves != 0:
                    median = float32_from_bits(np.uint32(pending[head + lowest_bit(halves)] >> UPPER))
            new = know_slots(
                keys_at, taken, candidates.numbers.ctypes.data, slot_of.ctypes.data,
                scratch.weights.ctypes.data, scratch.numbers.ctypes.data, scratch.slots.ctypes.data,
                scratch.depths.ctypes.data,
            )  # fmt: skip
            if new & (new - 1) != 0:
                ask_for_colours(new, scratch.numbers, ids, forward.scene)
            while new != 0:
                k = lowest_bit(new)
                new &= new - 1
                number = scratch.numbers[k]
                scratch.slots[k] = slot_of[number] = slots
                show(shown[slots], ids[number], forward.scene, limits, origin, scratch.basis)
                if recording:
                    kept.slot_ids[slot_base + slots] = ids[number]
                    for channel in range(3):
                        kept.slot_rgb[slot_base + slots, channel] = shown[slots, channel]
                slots += 1
            for f in range(feature_count):
                for k in range(taken):
                    out.features[r, f] += np.float32(
                        scratch.weights[k] * features[ids[scratch.numbers[k]], f]
                    )
            add_shown(
                scratch.sums.ctypes.data, shown.ctypes.data, scratch.slots.ctypes.data,
                scratch.weights.ctypes.data, taken,
            )  # fmt: skip
            if recording:
                keep_hits(
                    keys_at, taken, scratch.alphas.ctypes.data, scratch.slots.ctypes.data,
                    candidates.us.ctypes.data, candidates.vs.ctypes.data, place, hits.alphas.ctypes.data,
                    hits.distances.ctypes.data, kept.us.ctypes.data, kept.vs.ctypes.data,
                    kept.slots.ctypes.data,
                )  # fmt: skip
            t = scratch.after[taken - 1]
            head, place, found = head + taken, place + taken, found + taken
            stop = stop or found >= limits.max_hits
        b0 = b1
        stop = stop or nearest >= span[1]
    out.counts[r] = found
    out.transmittance[r] = t
    depth = 0.0
    for k in range(WIDTH):
        depth += scratch.depths[k]
    out.depth_sum[r] = depth
    out.depth_median[r] = median
    for axis in range(3):
        out.rgb[r, axis] = scratch.sums[axis]
        out.normal[r, axis] = scratch.sums[4 + axis]
    return place, slots


@kernel(error_model="numpy")
def trace_packets(forward, packets, tree, kept, counter):
    """Trace packets of rays ``packets[p, 0]`` to ``packets[p, 1]`` until the ``counter`` has passed the last.

    Packet p's hits are stored from the first place of its first ray on, and ``kept`` beside them. A ray's
    result depends on its packet alone, so it is the same for every number of threads.
    """
    pyramid, walk, scratch = new_pyramid(), new_walk(), new_scratch()
    candidates = new_candidates(START_ROOM)
    while True:
        packet = next_from_counter(counter.ctypes.data)
        if packet >= len(packets):
            break
        first, last = packets[packet, 0], packets[packet, 1]
        candidates, count = find_candidates(forward.rays, first, last, tree, pyramid, walk, candidates)
        sort_candidates(candidates, count, tree.order, walk.histogram)
        origin = ray_origin(forward.rays, first)
        write_rows(candidates, count, forward.scene, origin, pyramid.frame, True)
        candidates.slot_of[:count] = -1
        slots = 0
        place = slot_base = first_place(first, forward.limits)
        for r in range(first, last):
            place, slots = trace_ray(
                r, r - first, place, slots, slot_base, origin, pyramid.frame, forward, candidates, count,
                kept, scratch,
            )  # fmt: skip
        if forward.recording:
            kept.slot_counts[packet] = slots


@lean(fastmath={"contract"})
def absorb_ray(r, bit, rays, frame, candidates, count, limits):
    """What the candidates leave of ray ``r``, ray ``bit`` of its packet; 0 where that is below eps1."""
    slopes, span = ray_slopes(rays, r, frame), ray_limits(rays, r)
    block_count = (count + WIDTH - 1) // WIDTH
    left = 1.0
    for b0 in range(0, block_count, STRIDE):
        tail = meet_blocks(candidates, bit, b0, slopes, span, 0)
        know_alphas(candidates, 0, tail, limits.alpha_max)
        for m in range(tail):
            left *= 1.0 - candidates.alphas[m]
            if left < limits.eps1:
                return 0.0
    return left


@kernel(error_model="numpy")
def absorb_packets(rays, scene, limits, packets, tree, counter, transmittance):
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
        write_rows(candidates, count, scene, ray_origin(rays, first), pyramid.frame, False)
        for r in range(first, last):
            transmittance[r] = absorb_ray(r, r - first, rays, pyramid.frame, candidates, count, limits)
