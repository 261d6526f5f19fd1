"""Forward passes for packets: candidates once a packet, then each ray sorts and composites its own hits."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt64

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.trace.cpu.kernels.kernel_args import (
    BvhArrays,
    Candidates,
    ForwardPass,
    OutputArrays,
    PackedScene,
    PacketHits,
    TraceLimits,
)
from octasplat.engine.trace.cpu.kernels.octagon_hit import MEAN, NORMAL
from octasplat.engine.trace.cpu.kernels.packet_bvh import WIDTH
from octasplat.engine.trace.cpu.kernels.packet_candidates import (
    COLOR_NORMAL_WORDS,
    INITIAL_CAPACITY,
    PRIMITIVE_BYTES,
    allocate_candidates,
    find_candidates,
    write_candidate_blocks,
)
from octasplat.engine.trace.cpu.kernels.packet_hits import (
    BLOCKS_PER_CHUNK,
    HIGH_WORD_SHIFT,
    RANK_SORT_MAX,
    eval_alphas,
    intersect_blocks,
    sort_hits,
)
from octasplat.engine.trace.cpu.kernels.packet_sort import sort_candidates
from octasplat.engine.trace.cpu.kernels.packet_traversal import allocate_frustum, allocate_traversal
from octasplat.engine.trace.cpu.kernels.rays import (
    facing_sign,
    first_hit_index,
    next_packet,
    primitive_vector,
    ray_limits,
    ray_origin,
    ray_slopes,
)
from octasplat.engine.trace.cpu.kernels.simd8 import (
    HitStore,
    HitTables,
    accumulate_color_normals,
    composite8,
    lookup_slots8,
    store_hits8,
)
from octasplat.engine.trace.cpu.kernels.simd_vector import float32_bits, float32_from_bits, lowest_bit
from octasplat.engine.trace.cpu.kernels.spherical_harmonics import eval_color, eval_view_basis
from octasplat.engine.trace.kernels.native import (
    Address,
    njit_no_refcount,
    prefetch,
    prefetch_bytes,
)


class RayScratch(NamedTuple):
    """Memory of a thread: harmonics, keys that are sorted, sums of a ray, and eight hits."""

    basis: Float64[np.ndarray, "16"]
    rank_buffer: UInt64[np.ndarray, "104"]
    sums: Float64[np.ndarray, "8"]
    alphas: Float32[np.ndarray, "8"]
    weights: Float64[np.ndarray, "8"]
    transmittance_after: Float64[np.ndarray, "8"]
    depth_sums: Float64[np.ndarray, "8"]
    candidate_indices: Int64[np.ndarray, "8"]
    slots: Int64[np.ndarray, "8"]


class PacketTrace(NamedTuple):
    """A packet in progress: its candidates in order, and its stored hits.

    The Gaussians that it meets are listed from ``slot_base`` on. ``origin`` is that of its rays, and
    ``frame`` its axis, e and f.
    """

    forward: ForwardPass
    candidates: Candidates
    candidate_count: int
    hits: PacketHits
    slot_base: int
    origin: tuple[float, float, float]
    frame: Float64[np.ndarray, "15"]


@device_function(error_model="numpy")
def allocate_ray_scratch() -> RayScratch:
    """Return memory for rays, one after another."""
    return RayScratch(
        np.empty(16, np.float64),
        np.empty(RANK_SORT_MAX + WIDTH, np.uint64),
        np.empty(COLOR_NORMAL_WORDS, np.float64),
        np.empty(WIDTH, np.float32),
        np.empty(WIDTH, np.float64),
        np.empty(WIDTH, np.float64),
        np.empty(WIDTH, np.float64),
        np.empty(WIDTH, np.int64),
        np.empty(WIDTH, np.int64),
    )


@njit_no_refcount(forceinline=True)
def prefetch_colors(
    new_hits: int, candidate_indices: Int64[np.ndarray, "8"], ids: Int32[np.ndarray, " c"], scene: PackedScene
) -> None:
    """Prefetch the color data of the hits ``new_hits``, so that memory latencies overlap."""
    sh_at, sh_bytes = scene.sh.ctypes.data, scene.sh.shape[1] * 12
    while new_hits != 0:
        i = ids[candidate_indices[lowest_bit(new_hits)]]
        prefetch(scene.primitives.ctypes.data + i * PRIMITIVE_BYTES)
        prefetch_bytes(sh_at + i * sh_bytes, sh_bytes)
        new_hits &= new_hits - 1


@njit_no_refcount(fastmath={"contract"})
def eval_color_normal(
    color_normal: Float64[np.ndarray, "8"],
    i: int,
    scene: PackedScene,
    limits: TraceLimits,
    origin: tuple[float, float, float],
    basis: Float64[np.ndarray, " k"],
) -> None:
    """Write what Gaussian ``i`` shows to rays from ``origin``."""
    record = scene.primitives[i]
    x, y, z = record[MEAN] - origin[0], record[MEAN + 1] - origin[1], record[MEAN + 2] - origin[2]
    n0, n1, n2 = primitive_vector(record, NORMAL)
    eval_view_basis(basis, scene.sh.shape[1], x, y, z)
    color_normal[0], color_normal[1], color_normal[2] = eval_color(scene.sh, i, basis)
    color_normal[3] = color_normal[7] = 0.0
    side = facing_sign((x, y, z), (n0, n1, n2), limits)
    color_normal[4], color_normal[5], color_normal[6] = side * n0, side * n1, side * n2


@njit_no_refcount(forceinline=True)
def find_ray_end(
    bits: int,
    count: int,
    last_phase: bool,
    stop_below: float,
    eps2: float,
    transmittance_after: Float64[np.ndarray, "8"],
) -> tuple[int, bool, bool, float]:
    """Find where a ray ends among ``count`` hits; ``bits`` are those behind which too little is left.

    The second phase begins where too little is left, and ends where its own part of it is (Algorithm 1 of
    RaySplats).

    Returns:
        How many hits are taken, whether the ray ends with the last of them, whether the last phase has begun,
        and the transmittance below which that ends.
    """
    taken, stop = count, False
    if bits & ((1 << count) - 1) != 0:
        last = lowest_bit(bits)
        if not last_phase:
            last_phase = True
            # T2 = T / T_last, so that the phase ends where T < T_last eps2
            stop_below = transmittance_after[last] * eps2
            last += 1
            while last < count and transmittance_after[last] >= stop_below:
                last += 1
        if last < count:
            taken, stop = last + 1, True
    return taken, stop, last_phase, stop_below


@njit_no_refcount(forceinline=True)
def fill_slots(
    new_hits: int,
    slot_count: int,
    packet: PacketTrace,
    scratch: RayScratch,
) -> int:
    """Give each of the hits ``new_hits`` a slot of the packet, with its color and normal.

    Returns:
        The number of slots.
    """
    candidates, ids, forward = packet.candidates, packet.candidates.ids, packet.forward
    if new_hits & (new_hits - 1) != 0:  # a single one would be waited for at once
        prefetch_colors(new_hits, scratch.candidate_indices, ids, forward.scene)
    while new_hits != 0:
        k = lowest_bit(new_hits)
        new_hits &= new_hits - 1
        number = scratch.candidate_indices[k]
        scratch.slots[k] = candidates.slots[number] = slot_count
        color_normal = candidates.color_normals[slot_count]
        eval_color_normal(
            color_normal, ids[number], forward.scene, forward.limits, packet.origin, scratch.basis
        )
        if forward.is_recording:
            packet.hits.slot_ids[packet.slot_base + slot_count] = ids[number]
            for channel in range(3):
                packet.hits.slot_rgb[packet.slot_base + slot_count, channel] = color_normal[channel]
        slot_count += 1
    return slot_count


@njit_no_refcount(forceinline=True)
def store_hits(
    keys_at: Address, count: int, first_hit: int, packet: PacketTrace, scratch: RayScratch
) -> None:
    """Store the first ``count`` of eight hits from place ``first_hit`` on for the backward pass."""
    candidates, hits, packet_hits = packet.candidates, packet.forward.hits, packet.hits
    tables = HitTables(candidates.us.ctypes.data, candidates.vs.ctypes.data)
    out = HitStore(
        hits.alphas.ctypes.data, hits.distances.ctypes.data, packet_hits.us.ctypes.data,
        packet_hits.vs.ctypes.data, packet_hits.slots.ctypes.data,
    )  # fmt: skip
    store_hits8(keys_at, count, scratch.alphas.ctypes.data, scratch.slots.ctypes.data, tables, first_hit, out)


@njit_no_refcount(forceinline=True)
def write_ray_sums(
    r: int, count: int, transmittance: float, median: float, scratch: RayScratch, out: OutputArrays
) -> None:
    """Write the outputs of ray ``r``, which has ``count`` hits, but for the features."""
    out.counts[r] = count
    out.transmittance[r] = transmittance
    depth = 0.0
    for k in range(WIDTH):
        depth += scratch.depth_sums[k]
    out.depth_sum[r] = depth
    out.depth_median[r] = median
    for axis in range(3):
        out.rgb[r, axis] = scratch.sums[axis]
        out.normal[r, axis] = scratch.sums[4 + axis]


@njit_no_refcount(fastmath={"contract"})
def trace_ray(
    r: int, ray_bit: int, first_hit: int, slot_count: int, packet: PacketTrace, scratch: RayScratch
) -> tuple[int, int]:
    """Follow ray ``r``, which is ray ``ray_bit`` of its packet; its hits are stored from ``first_hit`` on.

    Returns:
        The place behind its last hit, and the number of Gaussians that the packet has met, so far
        ``slot_count``.
    """
    forward, candidates, count = packet.forward, packet.candidates, packet.candidate_count
    limits, out, features = forward.limits, forward.out, forward.scene.features
    keys, ids = candidates.hit_keys, candidates.ids
    slopes, span = ray_slopes(forward.rays, r, packet.frame), ray_limits(forward.rays, r)
    feature_count = features.shape[1]
    if forward.is_recording:
        forward.hits.starts[r] = first_hit
    # eight sums: color, 0, normal, 0
    scratch.sums[:] = 0.0
    scratch.depth_sums[:] = 0.0
    for f in range(feature_count):
        out.features[r, f] = np.float32(0.0)
    # --- the ray so far: transmittance, where its phase ends, median depth, hits composited ---
    transmittance, stop_below, last_phase = 1.0, limits.eps1, limits.eps2 > 1.0
    median = np.float32(0.0)
    found = 0
    # Hits head to tail have been met and wait; b0 is the next block to be tested.
    head = tail = b0 = 0
    block_count = (count + WIDTH - 1) // WIDTH
    stop = False
    while b0 < block_count and not stop:
        # --- meet the Gaussians of the next chunk, and sort what waits ---
        b1 = min(b0 + BLOCKS_PER_CHUNK, block_count)
        known = tail
        tail = intersect_blocks(candidates, ray_bit, b0, slopes, span, tail)
        if tail > known:
            eval_alphas(candidates, known, tail, limits.alpha_max)
            sort_hits(candidates, scratch.rank_buffer, head, tail)
        # What follows lies no nearer than this.
        nearest = candidates.min_distance_after[min(b1 * WIDTH, count)]
        safe = np.uint64(float32_bits(nearest)) << HIGH_WORD_SHIFT
        # --- composite the hits that no later chunk comes before, eight at a time ---
        while not stop and head < tail and keys[head] < safe:
            keys_at = keys.ctypes.data + head * 8
            bits = composite8(
                keys_at, min(tail - head, limits.max_hits - found), safe, candidates.alphas.ctypes.data,
                transmittance, stop_below, scratch.alphas.ctypes.data, scratch.weights.ctypes.data,
                scratch.transmittance_after.ctypes.data,
            )  # fmt: skip
            taken, stop, last_phase, stop_below = find_ray_end(
                bits, bits >> (2 * WIDTH), last_phase, stop_below, limits.eps2, scratch.transmittance_after
            )
            if transmittance > 0.5:  # the median lies among these eight only if it was not passed before
                halves = (bits >> WIDTH) & ((1 << taken) - 1)
                if halves != 0:
                    median = float32_from_bits(np.uint32(keys[head + lowest_bit(halves)] >> HIGH_WORD_SHIFT))
            new = lookup_slots8(
                keys_at, taken, candidates.hit_candidates.ctypes.data, candidates.slots.ctypes.data,
                scratch.weights.ctypes.data, scratch.candidate_indices.ctypes.data, scratch.slots.ctypes.data,
                scratch.depth_sums.ctypes.data,
            )  # fmt: skip
            slot_count = fill_slots(new, slot_count, packet, scratch)
            for f in range(feature_count):
                for k in range(taken):
                    out.features[r, f] += np.float32(
                        scratch.weights[k] * features[ids[scratch.candidate_indices[k]], f]
                    )
            accumulate_color_normals(
                scratch.sums.ctypes.data, candidates.color_normals.ctypes.data, scratch.slots.ctypes.data,
                scratch.weights.ctypes.data, taken,
            )  # fmt: skip
            if forward.is_recording:
                store_hits(keys_at, taken, first_hit, packet, scratch)
            transmittance = scratch.transmittance_after[taken - 1]
            head, first_hit, found = head + taken, first_hit + taken, found + taken
            # the tracer's own limit, beside that of the transmittance
            stop = stop or found >= limits.max_hits
        b0 = b1
        stop = stop or nearest >= span[1]
    write_ray_sums(r, found, transmittance, median, scratch, out)
    return first_hit, slot_count


@kernel(error_model="numpy")
def trace_packets(
    forward: ForwardPass,
    packets: Int64[np.ndarray, "p 2"],
    bvh: BvhArrays,
    packet_hits: PacketHits,
    counter: Int64[np.ndarray, "1"],
) -> None:
    """Trace packets of rays ``packets[p, 0]`` to ``packets[p, 1]`` until the ``counter`` has passed the last.

    Packet p's hits are stored from the first place of its first ray on, and ``packet_hits`` beside them. A
    ray's result depends on its packet alone, so it is the same for every number of threads.
    """
    pyramid, walk, scratch = allocate_frustum(), allocate_traversal(), allocate_ray_scratch()
    candidates = allocate_candidates(INITIAL_CAPACITY)
    while True:
        packet, first, last = next_packet(counter, packets)
        if packet < 0:
            break
        candidates, count = find_candidates(forward.rays, first, last, bvh, pyramid, walk, candidates)
        sort_candidates(candidates, count, bvh.order, walk.histogram)
        origin = ray_origin(forward.rays, first)
        write_candidate_blocks(candidates, count, forward.scene, origin, pyramid.frame, True)
        candidates.slots[:count] = -1
        slots = 0  # also the slots' place: each packet writes where its first ray may
        place = first_hit_index(first, forward.limits)
        state = PacketTrace(forward, candidates, count, packet_hits, place, origin, pyramid.frame)
        for r in range(first, last):
            place, slots = trace_ray(r, r - first, place, slots, state, scratch)
        if forward.is_recording:
            packet_hits.slot_counts[packet] = slots
