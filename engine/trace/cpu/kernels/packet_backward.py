"""The backward pass for packets: each packet sums its rays' shares of a Gaussian, then packets are summed.

All rays of a packet share the origin o, so that moments of u and v carry the whole gradient. With x = m -
o, n0 = <x, r1>, xa = <x, r2>/s2, xb = <x, r3>/s3 and t the distance, <d, r1> = n0/t and <d, r2>/s2 = (u +
xa)/t, hence

    tau = dL/dt / <d, r1> = (g_t t - h u (u + xa) - h v (v + xb)) / n0

and the sums of tau, tau u and tau v over the rays follow from the moments of h = dL/d ln(alpha) up to
degree 3.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.trace.cpu.kernels.kernel_args import (
    GaussianGradientArrays,
    GaussianParameters,
    GaussianSegments,
    HitArrays,
    OutputGradientArrays,
    PackedScene,
    PacketHits,
    RayArrays,
    TraceLimits,
)
from octasplat.engine.trace.cpu.kernels.packed_primitives import rotation_columns
from octasplat.engine.trace.cpu.kernels.packet_bvh import WIDTH
from octasplat.engine.trace.cpu.kernels.packet_candidates import PREFETCH_DISTANCE, PRIMITIVE_BYTES
from octasplat.engine.trace.cpu.kernels.rays import facing_sign, first_hit_index, ray_origin
from octasplat.engine.trace.cpu.kernels.simd8_backward import (
    HitGradients8,
    Hits8,
    accumulate_row,
    backward_hits8,
    transmittance_before8,
)
from octasplat.engine.trace.cpu.kernels.single_backward import (
    GaussianMoments,
    gaussian_frame,
    write_geometry_gradients,
)
from octasplat.engine.trace.cpu.kernels.spherical_harmonics import (
    accumulate_sh_gradient,
    eval_view_basis,
    mean_gradient,
    write_basis_gradient,
)
from octasplat.engine.trace.kernels.native import (
    atomic_fetch_next,
    njit_no_refcount,
    prefetch,
    prefetch_bytes,
)

# --- row of sums of a packet's rays for one of its Gaussians, float32, one cache line ---
H, HU, HV, HUU, HUV, HVV, HUUU, HVVV = range(8)  # the last two: h u (u^2 + v^2), h v (u^2 + v^2)
W, COUNT, ERROR, RED, GREEN, BLUE, PACKET = range(8, 15)  # the last is an int32
ROW_WORDS = 16
GT, GTU, GTV, N_0, N_1, N_2 = range(6)
GEOMETRY_WORDS = 6
"""A row's further sums where depths or normals have a gradient: g_t t and the turned normals' gradient."""
INITIAL_SLOTS = 256
"""Gaussians of a packet that a thread has room for at first."""


class MomentRows(NamedTuple):
    """A row for each Gaussian of each packet; packet p has those from ``firsts[p]`` on.

    ``weights`` are column W of the sums once more, side by side.
    """

    firsts: Int64[np.ndarray, " p1"]
    ids: Int32[np.ndarray, " e"]
    weights: Float32[np.ndarray, " e"]
    sums: Float32[np.ndarray, "e 16"]
    geometry: Float32[np.ndarray, "e _"]
    features: Float32[np.ndarray, "e f"]


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
    rays: RayArrays,
    packets: Int64[np.ndarray, "p 2"],
    packet_hits: PacketHits,
    parameters: GaussianParameters,
    limits: TraceLimits,
    output_gradients: OutputGradientArrays,
    rows: MomentRows,
) -> None:
    """Clear the moment rows for the Gaussians of a packet, and set their normals where needed."""
    first, slots = packets[packet, 0], packet_hits.slot_counts[packet]
    slot_base, base = first_hit_index(first, limits), rows.firsts[packet]
    means, quats = parameters.means, parameters.quats
    ox, oy, oz = ray_origin(rays, first)
    for slot in range(slots):
        i, row = packet_hits.slot_ids[slot_base + slot], base + slot
        rows.ids[row] = i
        rows.sums[row, :] = np.float32(0.0)
        for f in range(rows.features.shape[1]):
            rows.features[row, f] = np.float32(0.0)
        if output_gradients.has_geometry:
            for column in range(GEOMETRY_WORDS):
                rows.geometry[row, column] = np.float32(0.0)
            r1, _r2, _r3 = rotation_columns(
                np.float64(quats[i, 0]), np.float64(quats[i, 1]),
                np.float64(quats[i, 2]), np.float64(quats[i, 3]),
            )  # fmt: skip
            x, y, z = means[i, 0] - ox, means[i, 1] - oy, means[i, 2] - oz
            side = facing_sign((x, y, z), r1, limits)
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
    transmittance: Float64[np.ndarray, " h"],
) -> tuple[float, int]:
    """Write the transmittance before each of the ``count`` hits from ``start`` on, and behind the last.

    Returns:
        That behind the last, and which hit is at the median depth; -1 for none, or where it is not wanted.
    """
    t, median = 1.0, -1
    for begin in range(0, count, WIDTH):
        t = transmittance_before8(
            alphas.ctypes.data + (start + begin) * 4, min(WIDTH, count - begin), t,
            transmittance.ctypes.data + begin * 8,
        )  # fmt: skip
    transmittance[count] = t
    if wants_median:
        for k in range(count):
            if transmittance[k] > 0.5 and transmittance[k + 1] <= 0.5:
                median = k
    return t, median


@njit_no_refcount(fastmath={"contract"})
def backward_ray_in_packet(
    r: int,
    slot_base: int,
    first_row: int,
    scratch: PacketBackwardScratch,
    hits: HitArrays,
    packet_hits: PacketHits,
    counts: Int32[np.ndarray, " r"],
    features: Float32[np.ndarray, "n f"],
    limits: TraceLimits,
    output_gradients: OutputGradientArrays,
    rows: MomentRows,
) -> None:
    """Add the hits of ray ``r`` to the rows of its packet, which begin at ``first_row``.

    dL/dalpha_k = <g, T_k c_k - (C - prefix_k)/(1 - alpha_k)> for every channel, the part behind summed from
    the back in float64: as a difference of sums it would drown behind opaque surfaces.
    """
    through, normals, values = scratch.transmittance_before, scratch.normals, scratch.weight_gradients
    weights, shares, by_ray = scratch.weights, scratch.log_alpha_gradients, scratch.ray_gradients
    feature_count = features.shape[1]
    count, start = counts[r], hits.starts[r]
    # --- front to back: the transmittance before each hit, and the hit at the median depth ---
    t, median = write_transmittance(hits.alphas, start, count, output_gradients.has_geometry, through)
    gn0 = gn1 = gn2 = gd = gm = 0.0
    if output_gradients.has_geometry:
        gd, gm = np.float64(output_gradients.depth_sum[r]), np.float64(output_gradients.depth_median[r])
        gn0, gn1, gn2 = (
            np.float64(output_gradients.normal[r, 0]),
            np.float64(output_gradients.normal[r, 1]),
            np.float64(output_gradients.normal[r, 2]),
        )
    # --- what the ray counts for in the rows of its hits ---
    by_ray[W - 8], by_ray[ERROR - 8] = np.float32(1.0), output_gradients.ray_errors[r]
    by_ray[RED - 8], by_ray[GREEN - 8], by_ray[BLUE - 8] = (
        output_gradients.rgb[r, 0],
        output_gradients.rgb[r, 1],
        output_gradients.rgb[r, 2],
    )
    # --- back to front, eight hits at a time ---
    out = HitGradients8(
        rows.sums.ctypes.data + first_row * (ROW_WORDS * 4), weights.ctypes.data, shares.ctypes.data
    )
    behind = np.float64(output_gradients.transmittance[r]) * t
    for begin in range((count - 1) // WIDTH * WIDTH, -1, -WIDTH):
        n, e = min(WIDTH, count - begin), start + begin
        if output_gradients.has_geometry or feature_count > 0:
            for k in range(n):
                slot = packet_hits.slots[e + k]
                value = 0.0
                if output_gradients.has_geometry:
                    value += gd * hits.distances[e + k]
                    value += gn0 * normals[slot, 0] + gn1 * normals[slot, 1] + gn2 * normals[slot, 2]
                for f in range(feature_count):
                    value += (
                        np.float64(output_gradients.features[r, f])
                        * features[packet_hits.slot_ids[slot_base + slot], f]
                    )
                values[k] = value
        behind = backward_hits8(
            Hits8(
                hits.alphas.ctypes.data + e * 4, through.ctypes.data + begin * 8,
                packet_hits.slots.ctypes.data + e * 4, packet_hits.us.ctypes.data + e * 4,
                packet_hits.vs.ctypes.data + e * 4,
            ),
            values.ctypes.data, packet_hits.slot_rgb.ctypes.data + slot_base * 12, n, behind,
            np.float32(limits.alpha_max), by_ray.ctypes.data, out,
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
    rays: RayArrays,
    packets: Int64[np.ndarray, "p 2"],
    hits: HitArrays,
    packet_hits: PacketHits,
    counts: Int32[np.ndarray, " r"],
    parameters: GaussianParameters,
    features: Float32[np.ndarray, "n f"],
    limits: TraceLimits,
    output_gradients: OutputGradientArrays,
    rows: MomentRows,
) -> None:
    """Write the rows of one packet, the rays ``packets[packet, 0]`` to ``packets[packet, 1]``."""
    first, last, slots = packets[packet, 0], packets[packet, 1], packet_hits.slot_counts[packet]
    slot_base, base = first_hit_index(first, limits), rows.firsts[packet]
    words = rows.sums.view(np.int32)
    init_moment_rows(packet, scratch, rays, packets, packet_hits, parameters, limits, output_gradients, rows)
    for r in range(first, last):
        if counts[r] > 0:
            backward_ray_in_packet(
                r,
                slot_base,
                base,
                scratch,
                hits,
                packet_hits,
                counts,
                features,
                limits,
                output_gradients,
                rows,
            )
    for slot in range(slots):
        words[base + slot, PACKET] = packet
        rows.weights[base + slot] = rows.sums[base + slot, W]
        for channel in range(3):  # a colour clamped at zero gets no gradient
            if packet_hits.slot_rgb[slot_base + slot, channel] <= 0.0:
                rows.sums[base + slot, RED + channel] = np.float32(0.0)


@kernel(error_model="numpy")
def backward_packets(
    rays: RayArrays,
    packets: Int64[np.ndarray, "p 2"],
    hits: HitArrays,
    packet_hits: PacketHits,
    counts: Int32[np.ndarray, " r"],
    parameters: GaussianParameters,
    features: Float32[np.ndarray, "n f"],
    limits: TraceLimits,
    output_gradients: OutputGradientArrays,
    counter: Int64[np.ndarray, "1"],
    rows: MomentRows,
) -> None:
    """Replay packets until the ``counter`` has passed the last."""
    memory = allocate_backward_scratch(limits.max_hits, INITIAL_SLOTS)
    while True:
        packet = atomic_fetch_next(counter.ctypes.data)
        if packet >= len(packets):
            break
        slots = packet_hits.slot_counts[packet]
        if slots > len(memory.normals):
            memory = allocate_backward_scratch(limits.max_hits, slots * 5 // 4)
        backward_packet(
            packet,
            memory,
            rays,
            packets,
            hits,
            packet_hits,
            counts,
            parameters,
            features,
            limits,
            output_gradients,
            rows,
        )


@kernel(_nrt=False, error_model="numpy")
def reduce_weights(
    first: int,
    last: int,
    gaussian_segments: GaussianSegments,
    weights: Float32[np.ndarray, " e"],
    out: Float32[np.ndarray, " s"],
) -> None:
    """Sum the ``weights`` of the rows of each of the Gaussians ``first`` to ``last`` that were hit."""
    for segment in range(first, last):
        total = 0.0
        for k in range(gaussian_segments.starts[segment], gaussian_segments.starts[segment + 1]):
            total += weights[gaussian_segments.order[k]]
        out[segment] = total


class BackwardPass(NamedTuple):
    """A backward pass over packets: their rays, and the Gaussians as parameters and as packed."""

    rays: RayArrays
    packets: Int64[np.ndarray, "p 2"]
    parameters: GaussianParameters
    scene: PackedScene
    limits: TraceLimits


class ReduceScratch(NamedTuple):
    """Memory of a thread: sums of a Gaussian's rows, of those with one origin, and harmonics."""

    sums: Float64[np.ndarray, "16"]
    origin_sums: Float64[np.ndarray, "16"]
    basis: Float64[np.ndarray, "16"]


@njit_no_refcount(forceinline=True)
def packet_origin(
    row: int, words: Int32[np.ndarray, "e 16"], backward: BackwardPass
) -> tuple[float, float, float]:
    """Return the origin of the packet that a row is of."""
    return ray_origin(backward.rays, backward.packets[words[row, PACKET], 0])


@njit_no_refcount(forceinline=True)
def sum_rows_of_origin(
    k: int,
    end: int,
    origin: tuple[float, float, float],
    order: Int32[np.ndarray, " e"],
    backward: BackwardPass,
    rows: MomentRows,
    origin_sums: Float64[np.ndarray, "16"],
    features: Float32[np.ndarray, " f"],
) -> tuple[int, tuple[float, float, float], tuple[float, float, float]]:
    """Sum the rows ``order[k:end]`` up to the first one of another origin.

    Returns:
        The place of that one; sums of g_t t times 1, u and v; and of the gradient of the turned normal.
    """
    words, with_geometry = rows.sums.view(np.int32), rows.geometry.shape[1] > 0
    origin_sums[:] = 0.0
    gt = gtu = gtv = t0 = t1 = t2 = 0.0
    while True:
        if k + PREFETCH_DISTANCE < len(order):
            prefetch(rows.sums.ctypes.data + order[k + PREFETCH_DISTANCE] * (ROW_WORDS * 4))
        row = order[k]
        accumulate_row(origin_sums.ctypes.data, rows.sums[row].ctypes.data)
        if with_geometry:
            by_t = rows.geometry[row]
            gt, gtu, gtv = gt + by_t[GT], gtu + by_t[GTU], gtv + by_t[GTV]
            t0, t1, t2 = t0 + by_t[N_0], t1 + by_t[N_1], t2 + by_t[N_2]
        for f in range(len(features)):
            features[f] += rows.features[row, f]
        k += 1
        if k == end or packet_origin(order[k], words, backward) != origin:
            break
    return k, (gt, gtu, gtv), (t0, t1, t2)


@njit_no_refcount(fastmath={"contract"})
def reduce_packets_chunk(
    first: int,
    last: int,
    backward: BackwardPass,
    segments: GaussianSegments,
    segment_indices: Int64[np.ndarray, " s"],
    rows: MomentRows,
    out: GaussianGradientArrays,
    scratch: ReduceScratch,
) -> None:
    """Sum the rows of the Gaussians ``segment_indices[first:last]`` and write the gradients that follow.

    Rows are summed in the order of the packets. The frame is taken in float64 from the raw parameters:
    float32 axes would cost needles digits.
    """
    order, starts = segments.order, segments.starts
    parameters, scene, limits = backward.parameters, backward.scene, backward.limits
    means, quats, log_scales = parameters.means, parameters.quats, parameters.log_scales
    sums, here, basis = scratch.sums, scratch.origin_sums, scratch.basis
    basis_count = out.sh.shape[1]
    words = rows.sums.view(np.int32)
    with_geometry = rows.geometry.shape[1] > 0
    sh_bytes = scene.sh.shape[1] * 12
    for place in range(first, last):
        if place + PREFETCH_DISTANCE < last:
            ahead = segments.ids[starts[segment_indices[place + PREFETCH_DISTANCE]]]
            prefetch(scene.primitives.ctypes.data + ahead * PRIMITIVE_BYTES)
            prefetch_bytes(scene.sh.ctypes.data + ahead * sh_bytes, sh_bytes)
        segment = segment_indices[place]
        i = segments.ids[starts[segment]]
        sums[:] = 0.0
        out.sh[place, :, :] = np.float32(0.0)
        out.features[place, :] = np.float32(0.0)
        # --- the Gaussian's frame ---
        r1, r2, r3, s2, s3 = gaussian_frame(i, quats, log_scales)
        per_s2, per_s3 = 1.0 / s2, 1.0 / s3
        # --- sums over all rows: tau and its moments, dL by the normal, dL by the mean through the color ---
        tau = tau_u = tau_v = n0 = n1 = n2 = m0 = m1 = m2 = 0.0
        k, end = starts[segment], starts[segment + 1]
        while k < end:  # rows with one origin, such as those of one picture, become gradients together
            origin = packet_origin(order[k], words, backward)
            k, (gt, gtu, gtv), (t0, t1, t2) = sum_rows_of_origin(
                k, end, origin, order, backward, rows, here, out.features[place]
            )
            sums += here
            # --- tau, tau u and tau v from the moments of h (module docstring) ---
            x, y, z = means[i, 0] - origin[0], means[i, 1] - origin[1], means[i, 2] - origin[2]
            inverse = 1.0 / (x * r1[0] + y * r1[1] + z * r1[2])
            xa = (x * r2[0] + y * r2[1] + z * r2[2]) * per_s2
            xb = (x * r3[0] + y * r3[1] + z * r3[2]) * per_s3
            if with_geometry:  # the gradient of the turned normal, turned back
                side = facing_sign((x, y, z), r1, limits)
                n0, n1, n2 = n0 + side * t0, n1 + side * t1, n2 + side * t2
            hu, hv, huu, huv, hvv = here[HU], here[HV], here[HUU], here[HUV], here[HVV]
            tau += (gt - huu - xa * hu - hvv - xb * hv) * inverse
            tau_u += (gtu - here[HUUU] - xa * huu - xb * huv) * inverse
            tau_v += (gtv - here[HVVV] - xa * huv - xb * hvv) * inverse
            # --- harmonics, and the mean through the direction of view ---
            by_color = here[RED], here[GREEN], here[BLUE]
            view = eval_view_basis(basis, basis_count, x, y, z)
            accumulate_sh_gradient(out.sh, place, basis, basis_count, by_color)
            if basis_count > 1:
                write_basis_gradient(basis, scene.sh, i, basis_count, by_color)
                by_x, by_y, by_z = mean_gradient(basis, basis_count, view)
                m0, m1, m2 = m0 + by_x, m1 + by_y, m2 + by_z
        moments = GaussianMoments(
            sums[H], sums[HU], sums[HV], sums[HUU], sums[HUV], sums[HVV],
            tau, tau_u, tau_v, n0, n1, n2, m0, m1, m2,
        )  # fmt: skip
        write_geometry_gradients(place, i, (r1, r2, r3, s2, s3), quats, scene.primitives, moments, out)
        out.ids[place], out.weights[place] = i, sums[W]
        out.errors[place], out.counts[place] = sums[ERROR], np.int32(sums[COUNT])


@kernel(error_model="numpy")
def reduce_packets(
    backward: BackwardPass,
    segments: GaussianSegments,
    segment_indices: Int64[np.ndarray, " s"],
    rows: MomentRows,
    chunks: int,
    counter: Int64[np.ndarray, "1"],
    out: GaussianGradientArrays,
) -> None:
    """Sum the rows of the Gaussians that are numbers ``segment_indices`` of those that were hit.

    Takes one of ``chunks`` parts after the other until the ``counter`` has passed the last.
    """
    per_chunk = (len(segment_indices) + chunks - 1) // chunks
    while True:
        chunk = atomic_fetch_next(counter.ctypes.data)
        if chunk >= chunks:
            break
        first, last = chunk * per_chunk, min(len(segment_indices), (chunk + 1) * per_chunk)
        scratch = ReduceScratch(
            np.empty(ROW_WORDS, np.float64), np.empty(ROW_WORDS, np.float64), np.empty(16, np.float64)
        )
        reduce_packets_chunk(first, last, backward, segments, segment_indices, rows, out, scratch)
