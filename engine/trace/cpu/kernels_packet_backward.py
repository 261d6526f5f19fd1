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
from jaxtyping import Float32, Int32, Int64
from numba import njit, prange

from engine.trace.cpu.kernels_packet import AHEAD, exponential
from engine.trace.cpu.kernels_rays import ray_direction, ray_origin
from engine.trace.cpu.kernels_records import rotation_columns
from engine.trace.cpu.kernels_sh import write_basis
from engine.trace.cpu.kernels_simd import prefetch
from engine.trace.cpu.kernels_single_backward import Moments, write_gradients
from engine.trace.kernels_native import lean, next_from_counter

# --- sums of a packet's rays for one of its Gaussians, float64 scratch ---
H, HU, HV, HUU, HUV, HVV = range(6)
HUUU, HUUV, HUVV, HVVV = range(6, 10)
W, ERROR, COUNT, N_0, N_1, N_2 = range(10, 16)
GT, GTU, GTV = range(16, 19)
MOMENTS = 19
# --- row that a packet hands on, float32, one cache line: tau takes the third moments' place ---
TAU, TAU_U, TAU_V = range(6, 9)
ROW_WORDS = 16
START_SLOTS = 256
"""Gaussians of a packet that a thread has room for at first."""


class Rows(NamedTuple):
    """A row for each Gaussian of each packet; packet p has those from ``firsts[p]`` on."""

    firsts: Int64[np.ndarray, " p1"]
    ids: Int32[np.ndarray, " e"]
    sums: Float32[np.ndarray, "e 16"]
    sh: Float32[np.ndarray, "e k 3"]
    features: Float32[np.ndarray, "e f"]


@lean(fastmath={"contract"})
def replay_packet(packet, memory, rays, packets, hits, kept, counts, parameters, features, limits, g, rows):
    """Write the rows of one packet, the rays ``packets[packet, 0]`` to ``packets[packet, 1]``.

    dL/dalpha_k = <g, T_k c_k - (C - prefix_k)/(1 - alpha_k)> for every channel, the part behind summed from
    the back in float64: as a difference of sums it would drown behind opaque surfaces.
    """
    basis, g_basis, through, sums = memory
    first, last, slots = packets[packet, 0], packets[packet, 1], kept.slot_counts[packet]
    basis_count = rows.sh.shape[1]
    feature_count = features.shape[1]
    max_hits, alpha_limit = limits.max_hits, np.float32(limits.alpha_max)
    means, quats, log_scales = parameters.means, parameters.quats, parameters.log_scales
    means_at, quats_at, log_scales_at = means.ctypes.data, quats.ctypes.data, log_scales.ctypes.data
    base = rows.firsts[packet]
    for slot in range(slots):
        for column in range(MOMENTS):
            sums[slot, column] = 0.0
        for j in range(basis_count):
            for channel in range(3):
                rows.sh[base + slot, j, channel] = np.float32(0.0)
        for f in range(feature_count):
            rows.features[base + slot, f] = np.float32(0.0)
    for r in range(first, last):
        count = counts[r]
        start = hits.starts[r]
        t = 1.0
        median = -1
        for k in range(count):
            through[k] = t
            left = t * (1.0 - np.float64(hits.alphas[start + k]))
            if t > 0.5 and left <= 0.5:
                median = k
            t = left
        g0, g1, g2 = np.float64(g.rgb[r, 0]), np.float64(g.rgb[r, 1]), np.float64(g.rgb[r, 2])
        gn0 = gn1 = gn2 = gd = gm = 0.0
        d0, d1, d2 = ray_direction(rays, r)
        if g.with_geometry:
            gd, gm = np.float64(g.depth_sum[r]), np.float64(g.depth_median[r])
            gn0, gn1, gn2 = (
                np.float64(g.normal[r, 0]),
                np.float64(g.normal[r, 1]),
                np.float64(g.normal[r, 2]),
            )
        error = np.float64(g.ray_errors[r])
        write_basis(basis, basis_count, d0, d1, d2)
        for j in range(basis_count):
            b = np.float32(basis[j])
            g_basis[j, 0], g_basis[j, 1], g_basis[j, 2] = (
                b * g.rgb[r, 0],
                b * g.rgb[r, 1],
                b * g.rgb[r, 2],
            )
        behind = np.float64(g.transmittance[r]) * t
        for k in range(count - 1, -1, -1):
            e = start + k
            slot = kept.slots[e]
            row = base + slot
            alpha = np.float64(hits.alphas[e])
            weight = alpha * through[k]
            value = g0 * hits.rgb[e, 0] + g1 * hits.rgb[e, 1] + g2 * hits.rgb[e, 2]
            u, v = np.float64(kept.us[e]), np.float64(kept.vs[e])
            if g.with_geometry:
                i = kept.slot_ids[first * max_hits + slot]
                value += gd * hits.distances[e]
                r1, _r2, _r3 = rotation_columns(
                    np.float64(quats[i, 0]), np.float64(quats[i, 1]),
                    np.float64(quats[i, 2]), np.float64(quats[i, 3]),
                )  # fmt: skip
                along = gn0 * r1[0] + gn1 * r1[1] + gn2 * r1[2]
                # the normal is turned towards the viewer
                side = -1.0 if d0 * r1[0] + d1 * r1[1] + d2 * r1[2] > 0.0 else 1.0
                facing = side * weight
                value += side * along
                gt = (gd * weight + (gm if k == median else 0.0)) * hits.distances[e]
                sums[slot, GT] += gt
                sums[slot, GTU] += gt * u
                sums[slot, GTV] += gt * v
                sums[slot, N_0] += facing * gn0
                sums[slot, N_1] += facing * gn1
                sums[slot, N_2] += facing * gn2
            for f in range(feature_count):
                i = kept.slot_ids[first * max_hits + slot]
                value += np.float64(g.features[r, f]) * features[i, f]
                rows.features[row, f] += np.float32(weight * g.features[r, f])
            g_alpha = through[k] * value - behind / (1.0 - alpha)
            behind += weight * value
            h = 0.0 if hits.alphas[e] >= alpha_limit else g_alpha * alpha
            hu, hv = h * u, h * v
            sums[slot, H] += h
            sums[slot, HU] += hu
            sums[slot, HV] += hv
            huu, huv, hvv = hu * u, hu * v, hv * v
            sums[slot, HUU] += huu
            sums[slot, HUV] += huv
            sums[slot, HVV] += hvv
            sums[slot, HUUU] += huu * u
            sums[slot, HUUV] += huu * v
            sums[slot, HUVV] += hvv * u
            sums[slot, HVVV] += hvv * v
            sums[slot, W] += weight
            sums[slot, ERROR] += weight * error
            sums[slot, COUNT] += 1.0
            # a colour clamped at zero gets no gradient
            w = np.float32(weight)
            wr = w if hits.rgb[e, 0] > 0.0 else np.float32(0.0)
            wg = w if hits.rgb[e, 1] > 0.0 else np.float32(0.0)
            wb = w if hits.rgb[e, 2] > 0.0 else np.float32(0.0)
            for j in range(basis_count):
                rows.sh[row, j, 0] += wr * g_basis[j, 0]
                rows.sh[row, j, 1] += wg * g_basis[j, 1]
                rows.sh[row, j, 2] += wb * g_basis[j, 2]
    ox, oy, oz = ray_origin(rays, first)
    for slot in range(slots):
        if slot + AHEAD < slots:
            ahead = kept.slot_ids[first * max_hits + slot + AHEAD]
            prefetch(means_at + ahead * 12)
            prefetch(quats_at + ahead * 16)
            prefetch(log_scales_at + ahead * 8)
        i = kept.slot_ids[first * max_hits + slot]
        row = base + slot
        rows.ids[row] = i
        # The frame in float64 from the raw parameters: float32 axes would cost needles digits.
        r1, r2, r3 = rotation_columns(
            np.float64(quats[i, 0]), np.float64(quats[i, 1]),
            np.float64(quats[i, 2]), np.float64(quats[i, 3]),
        )  # fmt: skip
        x, y, z = (
            np.float64(means[i, 0]) - ox,
            np.float64(means[i, 1]) - oy,
            np.float64(means[i, 2]) - oz,
        )
        inverse = 1.0 / (x * r1[0] + y * r1[1] + z * r1[2])
        xa = (x * r2[0] + y * r2[1] + z * r2[2]) * exponential(-np.float64(log_scales[i, 0]))
        xb = (x * r3[0] + y * r3[1] + z * r3[2]) * exponential(-np.float64(log_scales[i, 1]))
        hu, hv = sums[slot, HU], sums[slot, HV]
        huu, huv, hvv = sums[slot, HUU], sums[slot, HUV], sums[slot, HVV]
        tau = sums[slot, GT] - huu - xa * hu - hvv - xb * hv
        tau_u = sums[slot, GTU] - sums[slot, HUUU] - xa * huu - sums[slot, HUVV] - xb * huv
        tau_v = sums[slot, GTV] - sums[slot, HUUV] - xa * huv - sums[slot, HVVV] - xb * hvv
        for column in range(ROW_WORDS):
            rows.sums[row, column] = sums[slot, column]
        rows.sums[row, TAU], rows.sums[row, TAU_U] = tau * inverse, tau_u * inverse
        rows.sums[row, TAU_V] = tau_v * inverse


@njit(error_model="numpy")
def replay_from_counter(rays, packets, hits, kept, counts, parameters, features, limits, g, counter, rows):
    """Replay packets until the ``counter`` has passed the last."""
    basis = np.empty(16, np.float64)
    g_basis = np.empty((16, 3), np.float32)
    through = np.empty(limits.max_hits, np.float64)
    sums = np.empty((START_SLOTS, MOMENTS), np.float64)
    while True:
        packet = next_from_counter(counter.ctypes.data)
        if packet >= len(packets):
            break
        slots = kept.slot_counts[packet]
        if slots > len(sums):
            sums = np.empty((slots * 5 // 4, MOMENTS), np.float64)
        memory = basis, g_basis, through, sums
        replay_packet(
            packet, memory, rays, packets, hits, kept, counts, parameters, features, limits, g, rows
        )


@njit(cache=True, parallel=True, error_model="numpy")
def replay_packets(
    rays, packets, hits, kept, counts, parameters, features, limits, g, workers, counter, rows
):
    """:func:`replay_from_counter` on ``workers`` threads; ``counter`` holds one zero."""
    for _worker in prange(workers):
        replay_from_counter(rays, packets, hits, kept, counts, parameters, features, limits, g, counter, rows)


@lean(fastmath={"contract"})
def sum_chunk(first, last, parameters, records, by_gaussian, rows, out, sums):
    """Sum the rows of the Gaussians ``first`` to ``last`` in packet order; the sums become gradients.

    ``sums`` is room for one row.
    """
    order, starts = by_gaussian.order, by_gaussian.starts
    basis_count = out.sh.shape[1]
    feature_count = out.features.shape[1]
    for segment in range(first, last):
        i = by_gaussian.ids[starts[segment]]
        for column in range(ROW_WORDS):
            sums[column] = 0.0
        for j in range(basis_count):
            for channel in range(3):
                out.sh[segment, j, channel] = np.float32(0.0)
        for f in range(feature_count):
            out.features[segment, f] = np.float32(0.0)
        for k in range(starts[segment], starts[segment + 1]):
            if k + AHEAD < len(order):
                prefetch(rows.sums.ctypes.data + order[k + AHEAD] * (ROW_WORDS * 4))
            row = order[k]
            for column in range(ROW_WORDS):
                sums[column] += rows.sums[row, column]
            for j in range(basis_count):
                for channel in range(3):
                    out.sh[segment, j, channel] += rows.sh[row, j, channel]
            for f in range(feature_count):
                out.features[segment, f] += rows.features[row, f]
        out.ids[segment] = i
        moments = Moments(
            sums[H], sums[HU], sums[HV], sums[HUU], sums[HUV], sums[HVV],
            sums[TAU], sums[TAU_U], sums[TAU_V], sums[N_0], sums[N_1], sums[N_2],
        )  # fmt: skip
        write_gradients(segment, i, parameters, records, moments, out)
        out.weights[segment] = sums[W]
        out.errors[segment] = sums[ERROR]
        out.counts[segment] = np.int32(sums[COUNT])


@njit(cache=True, parallel=True, error_model="numpy")
def sum_packets(parameters, records, by_gaussian, rows, chunks, out):
    """:func:`sum_chunk` on all Gaussians that were hit."""
    segments = len(by_gaussian.starts) - 1
    per_chunk = (segments + chunks - 1) // chunks
    for chunk in prange(chunks):
        first, last = chunk * per_chunk, min(segments, (chunk + 1) * per_chunk)
        sum_chunk(first, last, parameters, records, by_gaussian, rows, out, np.empty(ROW_WORDS, np.float64))
