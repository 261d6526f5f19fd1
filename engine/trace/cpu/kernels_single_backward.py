"""The backward pass: ray by ray down to alpha, then Gaussian by Gaussian to the raw parameters.

The first kernel replays each ray front to back and leaves, for every hit, its weight w = alpha T and
h = dL/d ln(alpha). After the hits are sorted by Gaussian, the second kernel sums each Gaussian's share in
ray order in float64: no atomics, no dense buffer, and the same bits on any number of threads.
"""

import math

import numpy as np
from numba import njit, prange

from engine.trace.cpu.kernels_hit import NORMAL, OPACITY
from engine.trace.cpu.kernels_records import rotation_columns
from engine.trace.cpu.kernels_sh import write_basis
from engine.trace.kernels_native import next_from_counter

RED_OFF, GREEN_OFF, BLUE_OFF = 1 << 28, 1 << 29, 1 << 30
"""Bits of a hit's ray number: this channel's colour was clamped at zero and gets no gradient."""
RAY_BITS = (1 << 28) - 1


@njit(cache=True, parallel=True, fastmath={"contract"}, error_model="numpy")
def replay_rays(
    directions, records, features, starts, counts, offsets, ids, alphas, ts, hit_rgb, alpha_max,
    g_rgb, g_transmittance, g_depth, g_median, g_normal, g_feature, with_geometry,
    keys, rays, weights, h_alpha, g_t,
):  # fmt: skip
    """dL/dalpha_k = <g, T_k c_k - (C - prefix_k)/(1 - alpha_k)> for every channel (``method`` section 3).

    ``offsets`` are the places of the rays' hits in the compact output arrays.
    """
    feature_count = features.shape[1]
    for r in prange(len(counts)):
        t = 1.0
        median = -1
        for k in range(counts[r]):
            alpha = np.float64(alphas[starts[r] + k])
            weights[offsets[r] + k] = alpha * t
            if t > 0.5 and t * (1.0 - alpha) <= 0.5:
                median = k
            t *= 1.0 - alpha
        g0, g1, g2 = np.float64(g_rgb[r, 0]), np.float64(g_rgb[r, 1]), np.float64(g_rgb[r, 2])
        gn0 = gn1 = gn2 = gd = gm = 0.0
        dx, dy, dz = np.float64(directions[r, 0]), np.float64(directions[r, 1]), np.float64(directions[r, 2])
        if with_geometry:
            gd, gm = np.float64(g_depth[r]), np.float64(g_median[r])
            gn0, gn1, gn2 = np.float64(g_normal[r, 0]), np.float64(g_normal[r, 1]), np.float64(g_normal[r, 2])
        # What lies behind the current hit, as the gradient sees it: <g, C - prefix> over all channels. It is
        # summed from the back in float64: as a difference of sums it would drown behind opaque surfaces.
        behind = np.float64(g_transmittance[r]) * t
        for k in range(counts[r] - 1, -1, -1):
            e = starts[r] + k
            out = offsets[r] + k
            i = ids[e]
            alpha = np.float64(alphas[e])
            weight = np.float64(weights[out])
            value = g0 * hit_rgb[e, 0] + g1 * hit_rgb[e, 1] + g2 * hit_rgb[e, 2]
            gt = 0.0
            through = weight / alpha
            if with_geometry:
                value += gd * ts[e]
                gt = gd * weight
                n0, n1, n2 = records[i, NORMAL], records[i, NORMAL + 1], records[i, NORMAL + 2]
                along = gn0 * n0 + gn1 * n1 + gn2 * n2
                value += -along if dx * n0 + dy * n1 + dz * n2 > 0.0 else along
                if k == median:
                    gt += gm
            for f in range(feature_count):
                value += np.float64(g_feature[r, f]) * features[i, f]
            g_alpha = through * value - behind / (1.0 - alpha)
            behind += weight * value
            keys[out] = i
            flags = np.int64(r)
            if hit_rgb[e, 0] <= 0.0:
                flags |= RED_OFF
            if hit_rgb[e, 1] <= 0.0:
                flags |= GREEN_OFF
            if hit_rgb[e, 2] <= 0.0:
                flags |= BLUE_OFF
            rays[out] = flags
            h_alpha[out] = 0.0 if alphas[e] >= np.float32(alpha_max) else g_alpha * alpha
            g_t[out] = gt


@njit(fastmath={"contract"}, error_model="numpy")
def write_gradients(
    segment, i, quats, log_scales, records,
    s_h, s_hu, s_hv, s_huu, s_huv, s_hvv, s_tau, s_tau_u, s_tau_v, s_n0, s_n1, s_n2,
    out_means, out_quats, out_log_scales, out_logits,
):  # fmt: skip
    """Gradients of one Gaussian's raw geometry from its sums over rays.

    In the Gaussian's own frame, with u, v the hit in standard deviations, tau = dL/dt through the point
    over <d, r1>: dL/dm = S(h u)/s2 r2 + S(h v)/s3 r3 + S(tau) r1, dL/dln s = S(h u^2), S(h v^2), and the
    frame turns by the torque S r_i x dL/dr_i.
    """
    q0, q1, q2, q3 = (
        np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
    )  # fmt: skip
    r1, r2, r3 = rotation_columns(q0, q1, q2, q3)
    s2, s3 = math.exp(np.float64(log_scales[i, 0])), math.exp(np.float64(log_scales[i, 1]))
    inv_s2, inv_s3 = 1.0 / s2, 1.0 / s3
    # torque = r1 x G1 + r2 x G2 + r3 x G3, G1 = -(s_tau_u s2 r2 + s_tau_v s3 r3) + normal channel
    on_r3, on_r2 = -s_tau_u * s2, s_tau_v * s3
    on_r1 = -s_huv * s3 * inv_s2 + s_huv * s2 * inv_s3
    w0 = on_r1 * r1[0] + on_r2 * r2[0] + on_r3 * r3[0] + r1[1] * s_n2 - r1[2] * s_n1
    w1 = on_r1 * r1[1] + on_r2 * r2[1] + on_r3 * r3[1] + r1[2] * s_n0 - r1[0] * s_n2
    w2 = on_r1 * r1[2] + on_r2 * r2[2] + on_r3 * r3[2] + r1[0] * s_n1 - r1[1] * s_n0
    # dL/dq = 2 (0, w) q / |q|^2: the rotation depends on the direction of q only
    factor = 2.0 / (q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    out_quats[segment, 0] = factor * (-w0 * q1 - w1 * q2 - w2 * q3)
    out_quats[segment, 1] = factor * (w0 * q0 + w1 * q3 - w2 * q2)
    out_quats[segment, 2] = factor * (w1 * q0 + w2 * q1 - w0 * q3)
    out_quats[segment, 3] = factor * (w2 * q0 + w0 * q2 - w1 * q1)
    for axis in range(3):
        out_means[segment, axis] = s_hu * inv_s2 * r2[axis] + s_hv * inv_s3 * r3[axis] + s_tau * r1[axis]
    out_log_scales[segment, 0] = s_huu
    out_log_scales[segment, 1] = s_hvv
    out_logits[segment] = s_h * (1.0 - np.float64(records[i, OPACITY]))


@njit(fastmath={"contract"}, error_model="numpy")
def gather_chunk(
    first, last, basis, sh_sum, feature_sum,
    origins, directions, records, means, quats, log_scales, order, sorted_keys, starts,
    rays, weights, h_alpha, g_t, g_rgb, g_normal, g_feature, ray_errors, with_geometry,
    out_ids, out_means, out_quats, out_log_scales, out_logits, out_sh, out_features,
    out_weights, out_errors, out_counts,
):  # fmt: skip
    """Gradients of the Gaussians ``first`` to ``last`` of the sorted hits.

    In the Gaussian's own frame, with u, v the hit in standard deviations, tau = dL/dt through the point and
    c = <d, r1>: dL/dm = S(h u)/s2 r2 + S(h v)/s3 r3 + S(tau/c) r1, dL/dln s = S(h u^2), S(h v^2), and the
    frame turns by the torque S r_i x dL/dr_i. The term through t (plane hit) is in tau.
    """
    basis_count = out_sh.shape[1]
    feature_count = out_features.shape[1]
    for segment in range(first, last):
        i = sorted_keys[starts[segment]]
        # The frame in float64 from the raw parameters: the record's float32 axes would cost needles digits.
        q0, q1, q2, q3 = (
            np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
        )  # fmt: skip
        r1, r2, r3 = rotation_columns(q0, q1, q2, q3)
        s2, s3 = math.exp(np.float64(log_scales[i, 0])), math.exp(np.float64(log_scales[i, 1]))
        inv_s2, inv_s3 = 1.0 / s2, 1.0 / s3
        m0, m1, m2 = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        n0, n1, n2 = r1
        a0, a1, a2 = r2[0] * inv_s2, r2[1] * inv_s2, r2[2] * inv_s2
        b0, b1, b2 = r3[0] * inv_s3, r3[1] * inv_s3, r3[2] * inv_s3
        s_h = s_hu = s_hv = s_huu = s_hvv = s_huv = 0.0
        s_tau = s_tau_u = s_tau_v = 0.0
        s_n0 = s_n1 = s_n2 = s_w = s_error = 0.0
        sh_sum[:basis_count] = 0.0
        feature_sum[:] = 0.0
        for k in range(starts[segment], starts[segment + 1]):
            e = order[k]
            r = rays[e] & RAY_BITS
            h = np.float64(h_alpha[e])
            w = np.float64(weights[e])
            d0, d1, d2 = (
                np.float64(directions[r, 0]),
                np.float64(directions[r, 1]),
                np.float64(directions[r, 2]),
            )
            x, y, z = origins[r, 0] - m0, origins[r, 1] - m1, origins[r, 2] - m2
            inverse = 1.0 / (d0 * n0 + d1 * n1 + d2 * n2)
            t = -(x * n0 + y * n1 + z * n2) * inverse
            x += t * d0
            y += t * d1
            z += t * d2
            u = x * a0 + y * a1 + z * a2
            v = x * b0 + y * b1 + z * b2
            hu, hv = h * u, h * v
            tau = np.float64(g_t[e]) - hu * (a0 * d0 + a1 * d1 + a2 * d2) - hv * (b0 * d0 + b1 * d1 + b2 * d2)
            tau *= inverse
            s_h += h
            s_hu += hu
            s_hv += hv
            s_huu += hu * u
            s_hvv += hv * v
            s_huv += hu * v
            s_tau += tau
            s_tau_u += tau * u
            s_tau_v += tau * v
            s_w += w
            s_error += w * ray_errors[r]
            gr = 0.0 if rays[e] & RED_OFF else w * g_rgb[r, 0]
            gg = 0.0 if rays[e] & GREEN_OFF else w * g_rgb[r, 1]
            gb = 0.0 if rays[e] & BLUE_OFF else w * g_rgb[r, 2]
            if basis_count == 1:
                sh_sum[0, 0] += gr
                sh_sum[0, 1] += gg
                sh_sum[0, 2] += gb
            else:
                write_basis(basis, basis_count, d0, d1, d2)
                for j in range(basis_count):
                    sh_sum[j, 0] += basis[j] * gr
                    sh_sum[j, 1] += basis[j] * gg
                    sh_sum[j, 2] += basis[j] * gb
            if with_geometry:
                facing = -w if inverse > 0.0 else w
                s_n0 += facing * g_normal[r, 0]
                s_n1 += facing * g_normal[r, 1]
                s_n2 += facing * g_normal[r, 2]
            for f in range(feature_count):
                feature_sum[f] += w * g_feature[r, f]
        write_gradients(
            segment, i, quats, log_scales, records,
            s_h, s_hu, s_hv, s_huu, s_huv, s_hvv, s_tau, s_tau_u, s_tau_v, s_n0, s_n1, s_n2,
            out_means, out_quats, out_log_scales, out_logits,
        )  # fmt: skip
        for j in range(basis_count):
            for channel in range(3):
                # degree 0 skips the basis in the loop above
                out_sh[segment, j, channel] = sh_sum[j, channel] * (
                    0.28209479177387814 if basis_count == 1 else 1.0
                )
        for f in range(feature_count):
            out_features[segment, f] = feature_sum[f]
        out_ids[segment] = i
        out_weights[segment] = s_w
        out_errors[segment] = s_error
        out_counts[segment] = starts[segment + 1] - starts[segment]


@njit(cache=True, parallel=True, fastmath={"contract"}, error_model="numpy")
def gather_gaussians(
    origins, directions, records, means, quats, log_scales,
    order, sorted_keys, starts, chunk_bounds, workers, counter,
    rays, weights, h_alpha, g_t, g_rgb, g_normal, g_feature, ray_errors, with_geometry,
    out_ids, out_means, out_quats, out_log_scales, out_logits, out_sh, out_features,
    out_weights, out_errors, out_counts,
):  # fmt: skip
    """Sum the hits of each Gaussian and turn the sums into gradients of its raw parameters."""
    feature_count = out_features.shape[1]
    for _worker in prange(workers):
        basis = np.empty(16, np.float64)
        sh_sum = np.empty((16, 3), np.float64)
        feature_sum = np.empty(max(feature_count, 1), np.float64)
        while True:
            chunk = next_from_counter(counter.ctypes.data)
            if chunk >= len(chunk_bounds) - 1:
                break
            gather_chunk(
                chunk_bounds[chunk], chunk_bounds[chunk + 1], basis, sh_sum, feature_sum,
                origins, directions, records, means, quats, log_scales, order, sorted_keys, starts,
                rays, weights, h_alpha, g_t, g_rgb, g_normal, g_feature, ray_errors, with_geometry,
                out_ids, out_means, out_quats, out_log_scales, out_logits, out_sh, out_features,
                out_weights, out_errors, out_counts,
            )  # fmt: skip
