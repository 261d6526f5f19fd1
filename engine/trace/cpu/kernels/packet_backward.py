"""The backward pass for packets: each packet sums its rays' shares of a Gaussian, then packets are summed.

All rays of a packet share the origin o, so that moments of u and v carry the whole gradient. With x = m -
o, n0 = <x, r1>, xa = <x, r2>/s2, xb = <x, r3>/s3 and t the distance, <d, r1> = n0/t and <d, r2>/s2 = (u +
xa)/t, hence

    tau = dL/dt / <d, r1> = (g_t t - h u (u + xa) - h v (v + xb)) / n0

and the sums of tau, tau u and tau v over the rays follow from the moments of h = dL/d ln(alpha) up to
degree 3.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.trace.cpu.kernels.packed_primitives import rotation_columns
from octasplat.engine.trace.cpu.kernels.packet_bvh import WIDTH
from octasplat.engine.trace.cpu.kernels.packet_candidates import PREFETCH_DISTANCE, PRIMITIVE_BYTES
from octasplat.engine.trace.cpu.kernels.rays import facing_sign, first_hit_index, ray_origin
from octasplat.engine.trace.cpu.kernels.simd8_backward import (
    accumulate_row,
    backward_hits8,
    transmittance_before8,
)
from octasplat.engine.trace.cpu.kernels.single_backward import GaussianMoments, write_geometry_gradients
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
    """Memory of a thread: the transmittance before each hit, turned normals of a packet, and eight hits."""

    transmittance_before: Float64[np.ndarray, " h"]
    normals: Float64[np.ndarray, "s 3"]
    weight_gradients: Float64[np.ndarray, "8"]
    weights: Float32[np.ndarray, "8"]
    log_alpha_gradients: Float32[np.ndarray, "8"]
    ray_gradients: Float32[np.ndarray, "8"]


@device_function(error_model="numpy")
def allocate_backward_scratch(max_hits, slots):
    """Memory for packets, one after another."""
    return PacketBackwardScratch(
        np.empty(max_hits + WIDTH, np.float64),
        np.empty((slots, 3), np.float64),
        np.zeros(WIDTH, np.float64),
        np.empty(WIDTH, np.float32),
        np.empty(WIDTH, np.float32),
        np.zeros(WIDTH, np.float32),
    )


@njit_no_refcount(fastmath={"contract"})
def init_moment_rows(packet, scratch, rays, packets, packet_hits, parameters, limits, output_gradients, rows):
    """Rows of zeros for the Gaussians of a packet, and their normals where those have a gradient."""
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


@njit_no_refcount(fastmath={"contract"})
def backward_ray_in_packet(
    r, slot_base, first_row, scratch, hits, packet_hits, counts, features, limits, output_gradients, rows
):
    """Add the hits of ray ``r`` to the rows of its packet, which begin at ``first_row``.

    dL/dalpha_k = <g, T_k c_k - (C - prefix_k)/(1 - alpha_k)> for every channel, the part behind summed from
    the back in float64: as a difference of sums it would drown behind opaque surfaces.
    """
    through, normals, values = scratch.transmittance_before, scratch.normals, scratch.weight_gradients
    weights, shares, by_ray = scratch.weights, scratch.log_alpha_gradients, scratch.ray_gradients
    feature_count = features.shape[1]
    count, start = counts[r], hits.starts[r]
    t, median = 1.0, -1
    for begin in range(0, count, WIDTH):
        t = transmittance_before8(
            hits.alphas.ctypes.data + (start + begin) * 4, min(WIDTH, count - begin), t,
            through.ctypes.data + begin * 8,
        )  # fmt: skip
    through[count] = t
    gn0 = gn1 = gn2 = gd = gm = 0.0
    if output_gradients.has_geometry:
        gd, gm = np.float64(output_gradients.depth_sum[r]), np.float64(output_gradients.depth_median[r])
        gn0, gn1, gn2 = (
            np.float64(output_gradients.normal[r, 0]),
            np.float64(output_gradients.normal[r, 1]),
            np.float64(output_gradients.normal[r, 2]),
        )
        for k in range(count):
            if through[k] > 0.5 and through[k + 1] <= 0.5:
                median = k
    by_ray[W - 8], by_ray[ERROR - 8] = np.float32(1.0), output_gradients.ray_errors[r]
    by_ray[RED - 8], by_ray[GREEN - 8], by_ray[BLUE - 8] = (
        output_gradients.rgb[r, 0],
        output_gradients.rgb[r, 1],
        output_gradients.rgb[r, 2],
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
            hits.alphas.ctypes.data + e * 4, through.ctypes.data + begin * 8, values.ctypes.data,
            packet_hits.slots.ctypes.data + e * 4, packet_hits.us.ctypes.data + e * 4, packet_hits.vs.ctypes.data + e * 4,
            packet_hits.slot_rgb.ctypes.data + slot_base * 12, n, behind, np.float32(limits.alpha_max),
            by_ray.ctypes.data, rows.sums.ctypes.data + first_row * (ROW_WORDS * 4), weights.ctypes.data,
            shares.ctypes.data,
        )  # fmt: skip
        if not (output_gradients.has_geometry or feature_count > 0):
            continue
        for k in range(n):
            row = first_row + packet_hits.slots[e + k]
            if output_gradients.has_geometry:
                u, v, weight = packet_hits.us[e + k], packet_hits.vs[e + k], np.float64(weights[k])
                gt = (gd * weight + (gm if begin + k == median else 0.0)) * hits.distances[e + k]
                rows.geometry[row, GT] += gt
                rows.geometry[row, GTU] += gt * u
                rows.geometry[row, GTV] += gt * v
                rows.geometry[row, N_0] += weight * gn0
                rows.geometry[row, N_1] += weight * gn1
                rows.geometry[row, N_2] += weight * gn2
            for f in range(feature_count):
                rows.features[row, f] += weights[k] * output_gradients.features[r, f]


@njit_no_refcount(fastmath={"contract"})
def backward_packet(
    packet,
    scratch,
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
):
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
    rays, packets, hits, packet_hits, counts, parameters, features, limits, output_gradients, counter, rows
):
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
def reduce_weights(first, last, gaussian_segments, weights, out):
    """Sum the ``weights`` of the rows of each of the Gaussians ``first`` to ``last`` that were hit."""
    for segment in range(first, last):
        total = 0.0
        for k in range(gaussian_segments.starts[segment], gaussian_segments.starts[segment + 1]):
            total += weights[gaussian_segments.order[k]]
        out[segment] = total


@njit_no_refcount(fastmath={"contract"})
def reduce_packets_chunk(
    first,
    last,
    rays,
    packets,
    parameters,
    scene,
    limits,
    gaussian_segments,
    segment_indices,
    rows,
    out,
    sums,
    origin_sums,
    basis,
):
    """Sum the rows of the Gaussians ``segment_indices[first:last]`` in packet order; the sums become gradients.

    ``sums`` and ``origin_sums`` are room for one row each, ``basis`` for harmonics. The frame is taken in float64
    from the raw parameters: float32 axes would cost needles digits.
    """
    order, starts = gaussian_segments.order, gaussian_segments.starts
    means, quats, log_scales = parameters.means, parameters.quats, parameters.log_scales
    basis_count, feature_count = out.sh.shape[1], out.features.shape[1]
    words = rows.sums.view(np.int32)
    with_geometry = rows.geometry.shape[1] > 0
    sh_bytes = scene.sh.shape[1] * 12
    for place in range(first, last):
        if place + PREFETCH_DISTANCE < last:
            ahead = gaussian_segments.ids[starts[segment_indices[place + PREFETCH_DISTANCE]]]
            prefetch(scene.primitives.ctypes.data + ahead * PRIMITIVE_BYTES)
            prefetch_bytes(scene.sh.ctypes.data + ahead * sh_bytes, sh_bytes)
        segment = segment_indices[place]
        i = gaussian_segments.ids[starts[segment]]
        sums[:] = 0.0
        out.sh[place, :, :] = np.float32(0.0)
        for f in range(feature_count):
            out.features[place, f] = np.float32(0.0)
        r1, r2, r3 = rotation_columns(
            np.float64(quats[i, 0]), np.float64(quats[i, 1]),
            np.float64(quats[i, 2]), np.float64(quats[i, 3]),
        )  # fmt: skip
        s2, s3 = math.exp(np.float64(log_scales[i, 0])), math.exp(np.float64(log_scales[i, 1]))
        per_s2, per_s3 = 1.0 / s2, 1.0 / s3
        tau = tau_u = tau_v = n0 = n1 = n2 = m0 = m1 = m2 = 0.0
        k, end = starts[segment], starts[segment + 1]
        while k < end:  # rows with one origin, such as those of one picture, become gradients together
            ox, oy, oz = ray_origin(rays, packets[words[order[k], PACKET], 0])
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
                for f in range(feature_count):
                    out.features[place, f] += rows.features[row, f]
                k += 1
                if k == end or ray_origin(rays, packets[words[order[k], PACKET], 0]) != (ox, oy, oz):
                    break
            sums += origin_sums
            x, y, z = means[i, 0] - ox, means[i, 1] - oy, means[i, 2] - oz
            inverse = 1.0 / (x * r1[0] + y * r1[1] + z * r1[2])
            xa = (x * r2[0] + y * r2[1] + z * r2[2]) * per_s2
            xb = (x * r3[0] + y * r3[1] + z * r3[2]) * per_s3
            if with_geometry:  # the gradient of the turned normal, turned back
                side = facing_sign((x, y, z), r1, limits)
                n0, n1, n2 = n0 + side * t0, n1 + side * t1, n2 + side * t2
            hu, hv, huu, huv, hvv = (
                origin_sums[HU],
                origin_sums[HV],
                origin_sums[HUU],
                origin_sums[HUV],
                origin_sums[HVV],
            )
            tau += (gt - huu - xa * hu - hvv - xb * hv) * inverse
            tau_u += (gtu - origin_sums[HUUU] - xa * huu - xb * huv) * inverse
            tau_v += (gtv - origin_sums[HVVV] - xa * huv - xb * hvv) * inverse
            by_colour = origin_sums[RED], origin_sums[GREEN], origin_sums[BLUE]
            view = eval_view_basis(basis, basis_count, x, y, z)
            accumulate_sh_gradient(out.sh, place, basis, basis_count, by_colour)
            if basis_count > 1:
                write_basis_gradient(basis, scene.sh, i, basis_count, by_colour)
                by_x, by_y, by_z = mean_gradient(basis, basis_count, view)
                m0, m1, m2 = m0 + by_x, m1 + by_y, m2 + by_z
        out.ids[place] = i
        moments = GaussianMoments(
            sums[H], sums[HU], sums[HV], sums[HUU], sums[HUV], sums[HVV],
            tau, tau_u, tau_v, n0, n1, n2, m0, m1, m2,
        )  # fmt: skip
        frame = r1, r2, r3, s2, s3
        write_geometry_gradients(place, i, frame, parameters.quats, scene.primitives, moments, out)
        out.weights[place] = sums[W]
        out.errors[place] = sums[ERROR]
        out.counts[place] = np.int32(sums[COUNT])


@kernel(error_model="numpy")
def reduce_packets(
    rays, packets, parameters, scene, limits, gaussian_segments, segment_indices, rows, chunks, counter, out
):
    """:func:`reduce_packets_chunk` on the Gaussians that are numbers ``segment_indices`` of those that were hit.

    Takes one of ``chunks`` parts after the other until the ``counter`` has passed the last.
    """
    per_chunk = (len(segment_indices) + chunks - 1) // chunks
    while True:
        chunk = atomic_fetch_next(counter.ctypes.data)
        if chunk >= chunks:
            break
        first, last = chunk * per_chunk, min(len(segment_indices), (chunk + 1) * per_chunk)
        sums, here = np.empty(ROW_WORDS, np.float64), np.empty(ROW_WORDS, np.float64)
        reduce_packets_chunk(
            first, last, rays, packets, parameters, scene, limits, gaussian_segments, segment_indices, rows, out, sums, here,
            np.empty(16, np.float64),
        )  # fmt: skip
