"""The backward pass for packets: each packet sums its rays' shares of a Gaussian in a row of moments.

:mod:`octasplat.engine.trace.cpu.kernels.packet_reduction` sums the rows of a Gaussian, and says why they are
enough.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.trace.cpu.kernels.kernel_args import BackwardPass, HitArrays, PacketHits
from octasplat.engine.trace.cpu.kernels.moment_rows import (
    BLUE,
    ERROR,
    GEOMETRY_WORDS,
    GREEN,
    GT,
    GTU,
    GTV,
    N_0,
    N_1,
    N_2,
    PACKET,
    RED,
    ROW_WORDS,
    MomentRows,
    W,
)
from octasplat.engine.trace.cpu.kernels.packed_primitives import gaussian_axes
from octasplat.engine.trace.cpu.kernels.packet_bvh import WIDTH
from octasplat.engine.trace.cpu.kernels.rays import (
    facing_sign,
    first_hit_index,
    geometry_gradient,
    next_packet,
    ray_origin,
)
from octasplat.engine.trace.cpu.kernels.simd8_backward import (
    HitGradients8,
    Hits8,
    backward_hits8,
    transmittance_before8,
)
from octasplat.engine.trace.kernels.native import njit_no_refcount

INITIAL_SLOTS = 256
"""Gaussians of a packet that a thread has room for at first."""


class PacketBackwardScratch(NamedTuple):
    """Memory of a thread: transmittance before each hit, flipped normals of a packet, and eight hits."""

    transmittance_before: Float64[np.ndarray, " h"]
    normals: Float64[np.ndarray, "s 3"]
    weight_gradients: Float64[np.ndarray, "8"]
    weights: Float32[np.ndarray, "8"]
    log_alpha_gradients: Float32[np.ndarray, "8"]
    ray_gradients: Float32[np.ndarray, "8"]


@device_function(error_model="numpy")
def allocate_backward_scratch(max_hits: int, slots: int) -> PacketBackwardScratch:
    """Return memory for packets, one after another."""
    return PacketBackwardScratch(
        np.empty(max_hits + WIDTH, np.float64),
        np.empty((slots, 3), np.float64),
        np.zeros(WIDTH, np.float64),
        np.empty(WIDTH, np.float32),
        np.empty(WIDTH, np.float32),
        np.zeros(WIDTH, np.float32),
    )


@njit_no_refcount(fastmath={"contract"})
def init_moment_rows(
    packet: int,
    scratch: PacketBackwardScratch,
    backward: BackwardPass,
    packets: Int64[np.ndarray, "p 2"],
    packet_hits: PacketHits,
    rows: MomentRows,
) -> None:
    """Clear the moment rows for the Gaussians of a packet, and set their normals where needed."""
    first, slots = packets[packet, 0], packet_hits.slot_counts[packet]
    slot_base, base = first_hit_index(first, backward.limits), rows.firsts[packet]
    means, quats = backward.parameters.means, backward.parameters.quats
    ox, oy, oz = ray_origin(backward.rays, first)
    for slot in range(slots):
        i, row = packet_hits.slot_ids[slot_base + slot], base + slot
        rows.ids[row] = i
        rows.sums[row, :] = np.float32(0.0)
        for f in range(rows.features.shape[1]):
            rows.features[row, f] = np.float32(0.0)
        if backward.output_gradients.has_geometry:
            for column in range(GEOMETRY_WORDS):
                rows.geometry[row, column] = np.float32(0.0)
            # from the raw quaternion: the record's normal is rounded to float32
            r1, _r2, _r3 = gaussian_axes(quats, i)
            x, y, z = means[i, 0] - ox, means[i, 1] - oy, means[i, 2] - oz
            side = facing_sign((x, y, z), r1, backward.limits)
            for axis in range(3):
                scratch.normals[slot, axis] = side * r1[axis]


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def add_geometry_row(
    row: Float32[np.ndarray, "6"],
    gt: float,
    u: float,
    v: float,
    weight: float,
    normal_gradient: tuple[float, float, float],
) -> None:
    """Add a hit at u, v to the sums for depths and normals; ``gt`` is dL/dt times the distance t."""
    row[GT] += gt
    row[GTU] += gt * u
    row[GTV] += gt * v
    row[N_0] += weight * normal_gradient[0]
    row[N_1] += weight * normal_gradient[1]
    row[N_2] += weight * normal_gradient[2]


@njit_no_refcount(forceinline=True)
def write_transmittance(
    alphas: Float32[np.ndarray, " h"],
    start: int,
    count: int,
    wants_median: bool,
    transmittance_before: Float64[np.ndarray, " h"],
) -> tuple[float, int]:
    """Write the transmittance before each of the ``count`` hits from ``start`` on, and behind the last.

    Returns:
        That behind the last, and which hit is at the median depth; -1 for none, or where it is not wanted.
    """
    transmittance, median = 1.0, -1
    for begin in range(0, count, WIDTH):
        transmittance = transmittance_before8(
            alphas.ctypes.data + (start + begin) * 4, min(WIDTH, count - begin), transmittance,
            transmittance_before.ctypes.data + begin * 8,
        )  # fmt: skip
    transmittance_before[count] = transmittance
    if wants_median:
        for k in range(count):
            if transmittance_before[k] > 0.5 and transmittance_before[k + 1] <= 0.5:
                median = k
    return transmittance, median


@njit_no_refcount(fastmath={"contract"})
def backward_ray_in_packet(
    r: int,
    slot_base: int,
    first_row: int,
    scratch: PacketBackwardScratch,
    backward: BackwardPass,
    hits: HitArrays,
    packet_hits: PacketHits,
    counts: Int32[np.ndarray, " r"],
    rows: MomentRows,
) -> None:
    """Add the hits of ray ``r`` to the rows of its packet, which begin at ``first_row``.

    dL/dalpha_k = <g, T_k c_k - (C - prefix_k)/(1 - alpha_k)> for every channel, the part behind summed from
    the back in float64: as a difference of sums it would drown behind opaque surfaces.
    """
    transmittance_before, weight_gradients = scratch.transmittance_before, scratch.weight_gradients
    weights, log_alpha_gradients = scratch.weights, scratch.log_alpha_gradients
    normals, ray_gradients = scratch.normals, scratch.ray_gradients
    features, output_gradients = backward.scene.features, backward.output_gradients
    feature_count = features.shape[1]
    count, start = counts[r], hits.starts[r]
    # --- front to back: the transmittance before each hit, and the hit at the median depth ---
    transmittance, median = write_transmittance(
        hits.alphas, start, count, output_gradients.has_geometry, transmittance_before
    )
    gd, gm, (gn0, gn1, gn2) = geometry_gradient(output_gradients, r)
    # --- what the ray counts for in the rows of its hits ---
    ray_gradients[W - 8], ray_gradients[ERROR - 8] = np.float32(1.0), output_gradients.ray_errors[r]
    ray_gradients[RED - 8], ray_gradients[GREEN - 8], ray_gradients[BLUE - 8] = (
        output_gradients.rgb[r, 0],
        output_gradients.rgb[r, 1],
        output_gradients.rgb[r, 2],
    )
    # --- back to front, eight hits at a time ---
    out = HitGradients8(
        rows.sums.ctypes.data + first_row * (ROW_WORDS * 4),
        weights.ctypes.data,
        log_alpha_gradients.ctypes.data,
    )
    behind = np.float64(output_gradients.transmittance[r]) * transmittance
    # from the last group of eight, which may be incomplete
    for begin in range((count - 1) // WIDTH * WIDTH, -1, -WIDTH):
        n, e = min(WIDTH, count - begin), start + begin
        if output_gradients.has_geometry or feature_count > 0:
            for k in range(n):
                slot = packet_hits.slots[e + k]
                weight_gradient = 0.0
                if output_gradients.has_geometry:
                    weight_gradient += gd * hits.distances[e + k]
                    weight_gradient += (
                        gn0 * normals[slot, 0] + gn1 * normals[slot, 1] + gn2 * normals[slot, 2]
                    )
                for f in range(feature_count):
                    weight_gradient += (
                        np.float64(output_gradients.features[r, f])
                        * features[packet_hits.slot_ids[slot_base + slot], f]
                    )
                weight_gradients[k] = weight_gradient
        # the hits' part that all scenes have: colors and transmittance
        behind = backward_hits8(
            Hits8(
                hits.alphas.ctypes.data + e * 4, transmittance_before.ctypes.data + begin * 8,
                packet_hits.slots.ctypes.data + e * 4, packet_hits.us.ctypes.data + e * 4,
                packet_hits.vs.ctypes.data + e * 4,
            ),
            weight_gradients.ctypes.data, packet_hits.slot_rgb.ctypes.data + slot_base * 12, n, behind,
            np.float32(backward.limits.alpha_max), ray_gradients.ctypes.data, out,
        )  # fmt: skip
        if not (output_gradients.has_geometry or feature_count > 0):
            continue
        for k in range(n):
            row = first_row + packet_hits.slots[e + k]
            if output_gradients.has_geometry:
                u, v, weight = packet_hits.us[e + k], packet_hits.vs[e + k], np.float64(weights[k])
                gt = (gd * weight + (gm if begin + k == median else 0.0)) * hits.distances[e + k]
                add_geometry_row(rows.geometry[row], gt, u, v, weight, (gn0, gn1, gn2))
            for f in range(feature_count):
                rows.features[row, f] += weights[k] * output_gradients.features[r, f]


@njit_no_refcount(fastmath={"contract"})
def backward_packet(
    packet: int,
    scratch: PacketBackwardScratch,
    backward: BackwardPass,
    packets: Int64[np.ndarray, "p 2"],
    hits: HitArrays,
    packet_hits: PacketHits,
    counts: Int32[np.ndarray, " r"],
    rows: MomentRows,
) -> None:
    """Write the rows of one packet, the rays ``packets[packet, 0]`` to ``packets[packet, 1]``."""
    first, last, slots = packets[packet, 0], packets[packet, 1], packet_hits.slot_counts[packet]
    slot_base, base = first_hit_index(first, backward.limits), rows.firsts[packet]
    words = rows.sums.view(np.int32)
    init_moment_rows(packet, scratch, backward, packets, packet_hits, rows)
    for r in range(first, last):
        if counts[r] > 0:
            backward_ray_in_packet(r, slot_base, base, scratch, backward, hits, packet_hits, counts, rows)
    for slot in range(slots):
        words[base + slot, PACKET] = packet
        rows.weights[base + slot] = rows.sums[base + slot, W]
        for channel in range(3):  # a color clamped at zero gets no gradient
            if packet_hits.slot_rgb[slot_base + slot, channel] <= 0.0:
                rows.sums[base + slot, RED + channel] = np.float32(0.0)


@kernel(error_model="numpy")
def backward_packets(
    backward: BackwardPass,
    packets: Int64[np.ndarray, "p 2"],
    hits: HitArrays,
    packet_hits: PacketHits,
    counts: Int32[np.ndarray, " r"],
    counter: Int64[np.ndarray, "1"],
    rows: MomentRows,
) -> None:
    """Replay packets until the ``counter`` has passed the last."""
    max_hits = backward.limits.max_hits
    memory = allocate_backward_scratch(max_hits, INITIAL_SLOTS)
    while True:
        packet, _first, _last = next_packet(counter, packets)
        if packet < 0:
            break
        slots = packet_hits.slot_counts[packet]
        if slots > len(memory.normals):
            # a quarter more, so that slightly larger packets fit as well
            memory = allocate_backward_scratch(max_hits, slots * 5 // 4)
        backward_packet(packet, memory, backward, packets, hits, packet_hits, counts, rows)
