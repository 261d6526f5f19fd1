r"""Packets whose rays see their Gaussians in one order, for training.

A ray's own order of hits is exact, and most of what a hit costs: each ray tests, sorts and keeps its own.
Rays of a small packet meet much the same Gaussians in much the same order. Here the candidates of a packet
are sorted once, by the distance at which its axis meets them (the first steps of
:mod:`octasplat.engine.trace.cpu.kernels.packet_candidates`), and all of its rays composite them in that
order, sixteen rays at a time (:mod:`octasplat.engine.trace.cpu.kernels.simd16`), until none has light left:

    for each candidate, front to back        rays of the packet, sixteen to a vector
        alphas of the rays that may meet it   [. . a a a . . .]   octagon, distance and limits as ever
        its color, if any ray does           c
        what the rays see                     rgb += T a c,  T *= 1 - a

Kept of it are the Gaussians that were met, as lines, and which rays met them. The backward pass goes through
the same list from the back, finds the alphas again, and ends with one row of moments for each Gaussian of the
packet, like the other one's.

Not done: where octagons cross, and where a packet sees them obliquely, some of its rays composite in the
wrong order; what that costs is in docs/notes/speed.md, "One order". Nor is there a second phase, are there
features, or gradients by depths and normals; :class:`octasplat.engine.trace.cpu.tracer.CpuTracer` says when
this is used.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt64

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.trace.cpu.kernels.kernel_args import (
    BvhArrays,
    Candidates,
    ForwardPass,
    OutputArrays,
    RayArrays,
    SharedSortHits,
)
from octasplat.engine.trace.cpu.kernels.packet_candidates import (
    COLOR_NORMAL_WORDS,
    INITIAL_CAPACITY,
    PREFETCH_DISTANCE,
    PRIMITIVE_BYTES,
    allocate_aligned_float64,
    allocate_candidates,
    find_candidates,
    write_packet_primitive,
)
from octasplat.engine.trace.cpu.kernels.packet_forward import eval_color_normal
from octasplat.engine.trace.cpu.kernels.packet_sort import sort_by_distance
from octasplat.engine.trace.cpu.kernels.packet_traversal import allocate_frustum, allocate_traversal
from octasplat.engine.trace.cpu.kernels.rays import next_packet, ray_limits, ray_origin, ray_slopes
from octasplat.engine.trace.cpu.kernels.simd16 import (
    COLOR,
    COUNT,
    DEPTH,
    GROUP_SIZE,
    GROUPS,
    HIT_ROWS,
    MEDIAN,
    NORMAL_0,
    PACKET_PRIMITIVE_WORDS,
    PACKET_RAYS,
    PER_AXIS,
    RAY_ROWS,
    RED,
    SLOPE_A,
    SLOPE_B,
    STATE_ROWS,
    T_MAX,
    T_MIN,
    TRANSMITTANCE,
    composite_group16,
    intersect_group16,
)
from octasplat.engine.trace.kernels.native import (
    atomic_fetch_add,
    njit_no_refcount,
    prefetch,
    prefetch_bytes,
)

GROUP_MASK = np.uint64((1 << GROUP_SIZE) - 1)
CANDIDATE_MASK = np.uint64(0xFFFFFFFF)


class PacketScratch(NamedTuple):
    """Memory of a thread for a packet: rows of the sixteen-ray kernels, and what it meets.

    ``hit_ids``, ``hit_masks`` and ``packet_primitives`` have room for as many Gaussians as there are
    candidates.
    """

    ray_rows: Float32[np.ndarray, "5 64"]
    state_rows: Float32[np.ndarray, "10 64"]
    hit_rows: Float32[np.ndarray, "2 64"]
    normal: Float32[np.ndarray, "16"]
    color_normal: Float64[np.ndarray, "8"]
    basis: Float64[np.ndarray, "16"]
    hit_ids: Int32[np.ndarray, " c"]
    hit_masks: UInt64[np.ndarray, " c"]
    packet_primitives: Float32[np.ndarray, "c 16 1"]


@device_function(error_model="numpy")
def allocate_aligned_rows(rows: int, lanes: int) -> Float32[np.ndarray, "rows lanes"]:
    """Allocate rows of so many float32, a multiple of sixteen, aligned to cache lines."""
    return allocate_aligned_float64(rows * lanes // 2).view(np.float32).reshape((rows, lanes))


@device_function(error_model="numpy")
def allocate_packet_scratch(capacity: int) -> PacketScratch:
    """Return memory for packets of up to ``capacity`` candidates, one after another."""
    return PacketScratch(
        allocate_aligned_rows(RAY_ROWS, PACKET_RAYS),
        allocate_aligned_rows(STATE_ROWS, PACKET_RAYS),
        allocate_aligned_rows(HIT_ROWS, PACKET_RAYS),
        np.zeros(GROUP_SIZE, np.float32),
        np.empty(COLOR_NORMAL_WORDS, np.float64),
        np.empty(16, np.float64),
        np.empty(capacity, np.int32),
        np.empty(capacity, np.uint64),
        allocate_aligned_rows(capacity, PACKET_PRIMITIVE_WORDS).reshape(
            (capacity, PACKET_PRIMITIVE_WORDS, 1)
        ),
    )


@njit_no_refcount(fastmath={"contract"})
def write_ray_rows(
    rays: RayArrays,
    first: int,
    last: int,
    frame: Float64[np.ndarray, "15"],
    rows: Float32[np.ndarray, "5 64"],
) -> None:
    """Write the rays ``first`` to ``last``, at most 64, in their packet's frame; other lanes see nothing."""
    for r in range(first, last):
        k = r - first
        rows[SLOPE_A, k], rows[SLOPE_B, k], rows[PER_AXIS, k] = ray_slopes(rays, r, frame)
        rows[T_MIN, k], rows[T_MAX, k] = ray_limits(rays, r)
    for k in range(last - first, PACKET_RAYS):  # a zero length of sight: these lanes are never hit
        rows[SLOPE_A, k] = rows[SLOPE_B, k] = rows[T_MIN, k] = rows[T_MAX, k] = np.float32(0.0)
        rows[PER_AXIS, k] = np.float32(1.0)


@njit_no_refcount(forceinline=True)
def group_lanes(ray_mask: int, group: int) -> np.int64:
    """Return the lanes of a group of rays."""
    return np.int64((ray_mask >> np.uint64(GROUP_SIZE * group)) & GROUP_MASK)


@njit_no_refcount(fastmath={"contract"})
def trace_packet_shared_sort(
    first: int,
    last: int,
    origin: tuple[float, float, float],
    frame: Float64[np.ndarray, "15"],
    forward: ForwardPass,
    order: Int32[np.ndarray, " n"],
    candidates: Candidates,
    count: int,
    scratch: PacketScratch,
) -> int:
    """Composite the sorted candidates into the rays ``first`` to ``last``; returns how many were hit."""
    scene, limits, state_rows = forward.scene, forward.limits, scratch.state_rows
    keys, found, masks = candidates.keys, candidates.curve_indices, candidates.ray_masks
    records_at, sh_at = scene.primitives.ctypes.data, scene.sh.ctypes.data
    sh_bytes = scene.sh.shape[1] * 12
    rays_at, seen_at, met_at = (
        scratch.ray_rows.ctypes.data,
        state_rows.ctypes.data,
        scratch.hit_rows.ctypes.data,
    )
    least, most = np.float32(limits.eps1), np.float32(limits.max_hits)
    alpha_max = np.float32(limits.alpha_max)
    write_ray_rows(forward.rays, first, last, frame, scratch.ray_rows)
    state_rows[:, :] = np.float32(0.0)
    state_rows[TRANSMITTANCE, : last - first] = np.float32(1.0)
    # bits of the rays that still have transmittance left
    alive = ~np.uint64(0) >> np.uint64(PACKET_RAYS - (last - first))
    met = 0
    for k in range(count):
        # the records to come, as far as any live ray may meet them
        if k + PREFETCH_DISTANCE < count:
            which = np.int64(keys[k + PREFETCH_DISTANCE] & CANDIDATE_MASK)
            if masks[which] & alive != 0:
                ahead = order[found[which]]
                prefetch(records_at + ahead * PRIMITIVE_BYTES)
                prefetch_bytes(sh_at + ahead * sh_bytes, sh_bytes)
        which = np.int64(keys[k] & CANDIDATE_MASK)
        may = masks[which] & alive
        if may == 0:
            continue
        i, line = order[found[which]], scratch.packet_primitives[met]
        line_at = line.ctypes.data
        write_packet_primitive(line, 0, scene.primitives[i], origin, frame)
        # --- who hits it: sixteen rays at a time; its color is only evaluated if any does ---
        bits = np.uint64(0)
        for group in range(GROUPS):
            if group_lanes(may, group) != 0:
                here = intersect_group16(line_at, rays_at, seen_at, met_at, group, least, alpha_max, most)
                bits |= np.uint64(here) << np.uint64(GROUP_SIZE * group)
        if bits == 0:
            continue
        eval_color_normal(scratch.color_normal, i, scene, limits, origin, scratch.basis)
        for axis in range(3):
            line[COLOR + axis, 0], scratch.normal[axis] = (
                scratch.color_normal[axis],
                scratch.color_normal[4 + axis],
            )
        # --- composite it into those ---
        for group in range(GROUPS):
            here = group_lanes(bits, group)
            if here != 0:
                after = composite_group16(
                    line_at, scratch.normal.ctypes.data, seen_at, met_at, group, here, least
                )  # fmt: skip
                at = np.uint64(GROUP_SIZE * group)
                alive &= np.uint64(after) << at | ~(GROUP_MASK << at)  # clears bits of this group only
        scratch.hit_ids[met], scratch.hit_masks[met] = i, bits
        met += 1
        if alive == 0:
            break
    return met


@njit_no_refcount()
def write_packet_outputs(
    first: int, last: int, state_rows: Float32[np.ndarray, "10 64"], out: OutputArrays
) -> None:
    """Write what the rays ``first`` to ``last`` have seen."""
    for r in range(first, last):
        k = r - first
        out.counts[r] = np.int32(state_rows[COUNT, k])
        out.transmittance[r] = state_rows[TRANSMITTANCE, k]
        out.depth_sum[r], out.depth_median[r] = state_rows[DEPTH, k], state_rows[MEDIAN, k]
        for axis in range(3):
            out.rgb[r, axis], out.normal[r, axis] = state_rows[RED + axis, k], state_rows[NORMAL_0 + axis, k]


@njit_no_refcount()
def store_packet_hits(
    packet: int,
    hit_count: int,
    frame: Float64[np.ndarray, "15"],
    scratch: PacketScratch,
    packet_hits: SharedSortHits,
    start: int,
) -> None:
    """Store the hits of a packet from place ``start`` on."""
    packet_hits.starts[packet], packet_hits.counts[packet] = start, hit_count
    for k in range(9):
        packet_hits.frames[packet, k] = frame[k]
    for k in range(hit_count):
        packet_hits.ids[start + k], packet_hits.ray_masks[start + k] = (
            scratch.hit_ids[k],
            scratch.hit_masks[k],
        )
        for word in range(PACKET_PRIMITIVE_WORDS):
            packet_hits.packet_primitives[start + k, word] = scratch.packet_primitives[k, word, 0]


@kernel(error_model="numpy")
def trace_packets_shared_sort(
    forward: ForwardPass,
    packets: Int64[np.ndarray, "p 2"],
    bvh: BvhArrays,
    packet_hits: SharedSortHits,
    counter: Int64[np.ndarray, "1"],
    hit_counter: Int64[np.ndarray, "1"],
) -> None:
    """Trace packets until the ``counter`` has passed the last.

    What they meet is kept where ``hit_counter``, a counter too, says; where that is beyond the room of
    ``packet_hits`` it is only counted.
    """
    pyramid, walk = allocate_frustum(), allocate_traversal()
    candidates, view = allocate_candidates(INITIAL_CAPACITY), allocate_packet_scratch(INITIAL_CAPACITY)
    while True:
        packet, first, last = next_packet(counter, packets)
        if packet < 0:
            break
        candidates, count = find_candidates(forward.rays, first, last, bvh, pyramid, walk, candidates)
        if count > len(view.hit_ids):
            view = allocate_packet_scratch(len(candidates.curve_indices))
        sort_by_distance(candidates, count, walk.histogram)
        origin = ray_origin(forward.rays, first)
        met = trace_packet_shared_sort(
            first, last, origin, pyramid.frame, forward, bvh.order, candidates, count, view
        )
        write_packet_outputs(first, last, view.state_rows, forward.out)
        if forward.is_recording:
            # places are taken in the order in which packets finish; sums later go by packet
            start = atomic_fetch_add(hit_counter.ctypes.data, met)
            if start + met <= len(packet_hits.ids):
                store_packet_hits(packet, met, pyramid.frame, view, packet_hits, start)
