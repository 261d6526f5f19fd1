"""The backward pass: ray by ray down to alpha, then Gaussian by Gaussian to the raw parameters.

The first kernel replays each ray front to back and leaves, for every hit, its weight w = alpha T and
h = dL/d ln(alpha). After the hits are sorted by Gaussian, the second kernel sums each Gaussian's share in
ray order in float64: no atomics, no dense buffer, and the same bits on any number of threads.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from octasplat.engine.core.compilation import kernel
from octasplat.engine.gaussians.model import SH_C0
from octasplat.engine.trace.cpu.kernels.geometry_gradients import (
    GaussianMoments,
    gaussian_frame,
    write_geometry_gradients,
)
from octasplat.engine.trace.cpu.kernels.kernel_args import (
    BackwardPass,
    GaussianGradientArrays,
    GaussianSegments,
    HitArrays,
)
from octasplat.engine.trace.cpu.kernels.octagon_hit import MEAN, NORMAL
from octasplat.engine.trace.cpu.kernels.rays import (
    facing_sign,
    geometry_gradient,
    primitive_vector,
    ray_direction,
    ray_origin,
    ray_t_view_origin,
)
from octasplat.engine.trace.cpu.kernels.spherical_harmonics import (
    eval_ray_view_basis,
    mean_gradient,
    write_basis_gradient,
)
from octasplat.engine.trace.kernels.native import atomic_fetch_next, njit_no_refcount

RED_CLAMPED, GREEN_CLAMPED, BLUE_CLAMPED = 1 << 28, 1 << 29, 1 << 30
"""Bits of a hit's ray number: this channel's color was clamped at zero and gets no gradient."""
RAY_ID_MASK = (1 << 28) - 1


class HitGradients(NamedTuple):
    """Contributions of each hit of the replayed rays to the gradient of its Gaussian, ray after ray.

    ``ray_flags`` has a hit's ray in the bits below 2^28; ``h_alpha`` is dL/d ln(alpha), ``g_t`` is dL/dt.
    """

    ids: Int32[np.ndarray, " e"]
    ray_flags: Int32[np.ndarray, " e"]
    weights: Float32[np.ndarray, " e"]
    h_alpha: Float32[np.ndarray, " e"]
    g_t: Float32[np.ndarray, " e"]


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def backward_ray(
    r: int,
    first: int,
    backward: BackwardPass,
    hits: HitArrays,
    counts: Int32[np.ndarray, " r"],
    hit_gradients: HitGradients,
) -> None:
    """Write dL/dalpha_k = <g, T_k c_k - (C - prefix_k)/(1 - alpha_k)> of the hits of ray ``r``, per channel.

    They go to ``hit_gradients`` from ``first`` on.
    """
    rays, limits, output_gradients = backward.rays, backward.limits, backward.output_gradients
    records, features = backward.scene.primitives, backward.scene.features
    alphas, distances, hit_rgb = hits.alphas, hits.distances, hits.rgb
    weights = hit_gradients.weights
    feature_count = features.shape[1]
    # --- front to back: weights, and the hit at the median depth ---
    transmittance = 1.0
    median = -1
    for k in range(counts[r]):
        alpha = np.float64(alphas[hits.starts[r] + k])
        weights[first + k] = alpha * transmittance
        if transmittance > 0.5 and transmittance * (1.0 - alpha) <= 0.5:
            median = k
        transmittance *= 1.0 - alpha
    g0, g1, g2 = (
        np.float64(output_gradients.rgb[r, 0]),
        np.float64(output_gradients.rgb[r, 1]),
        np.float64(output_gradients.rgb[r, 2]),
    )
    gd, gm, (gn0, gn1, gn2) = geometry_gradient(output_gradients, r)
    ox, oy, oz = ray_origin(rays, r)
    # What lies behind the current hit, as the gradient sees it: <g, C - prefix> over all channels. It is
    # summed from the back in float64: as a difference of sums it would drown behind opaque surfaces.
    behind = np.float64(output_gradients.transmittance[r]) * transmittance
    for k in range(counts[r] - 1, -1, -1):
        e = hits.starts[r] + k
        out = first + k
        i = hits.ids[e]
        alpha = np.float64(alphas[e])
        weight = np.float64(weights[out])
        g_weight = g0 * hit_rgb[e, 0] + g1 * hit_rgb[e, 1] + g2 * hit_rgb[e, 2]
        gt = 0.0
        transmittance_before = weight / alpha  # alpha is above exp(-q / 2) inside the octagon
        if output_gradients.has_geometry:
            g_weight += gd * distances[e]
            gt = gd * weight
            n0, n1, n2 = primitive_vector(records[i], NORMAL)
            x, y, z = primitive_vector(records[i], MEAN)
            side = facing_sign((x - ox, y - oy, z - oz), (n0, n1, n2), limits)
            g_weight += side * (gn0 * n0 + gn1 * n1 + gn2 * n2)
            if k == median:
                gt += gm
        for f in range(feature_count):
            g_weight += np.float64(output_gradients.features[r, f]) * features[i, f]
        g_alpha = transmittance_before * g_weight - behind / (1.0 - alpha)
        behind += weight * g_weight
        hit_gradients.ids[out] = i
        flags = np.int64(r)
        if hit_rgb[e, 0] <= 0.0:
            flags |= RED_CLAMPED
        if hit_rgb[e, 1] <= 0.0:
            flags |= GREEN_CLAMPED
        if hit_rgb[e, 2] <= 0.0:
            flags |= BLUE_CLAMPED
        hit_gradients.ray_flags[out] = flags
        hit_gradients.h_alpha[out] = 0.0 if alphas[e] >= np.float32(limits.alpha_max) else g_alpha * alpha
        hit_gradients.g_t[out] = gt


@kernel(error_model="numpy")
def backward_rays(
    first: int,
    last: int,
    ray_indices: Int64[np.ndarray, " i"],
    offsets: Int64[np.ndarray, " i"],
    backward: BackwardPass,
    hits: HitArrays,
    counts: Int32[np.ndarray, " r"],
    hit_gradients: HitGradients,
) -> None:
    """Run :func:`backward_ray` on the rays ``ray_indices``.

    ``offsets`` are the places of their hits in ``hit_gradients``.
    """
    for s in range(first, last):
        backward_ray(ray_indices[s], offsets[s], backward, hits, counts, hit_gradients)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def hit_in_frame(
    h: float,
    g_t: float,
    from_mean: tuple[float, float, float],
    direction: tuple[float, float, float],
    normal: tuple[float, float, float],
    axis_u: tuple[float, float, float],
    axis_v: tuple[float, float, float],
) -> tuple[float, float, float]:
    """Return u, v and tau of a hit.

    ``from_mean`` leads from the Gaussian's mean to the ray's origin; the axes are r2 / s2 and r3 / s3;
    ``h`` is dL/d ln(alpha) and ``g_t`` dL/dt.
    """
    x, y, z = from_mean
    d0, d1, d2 = direction
    n0, n1, n2 = normal
    a0, a1, a2 = axis_u
    b0, b1, b2 = axis_v
    inverse = 1.0 / (d0 * n0 + d1 * n1 + d2 * n2)
    # o + t d, the hit, from the mean
    t = -(x * n0 + y * n1 + z * n2) * inverse
    x += t * d0
    y += t * d1
    z += t * d2
    u = x * a0 + y * a1 + z * a2
    v = x * b0 + y * b1 + z * b2
    tau = g_t - h * u * (a0 * d0 + a1 * d1 + a2 * d2) - h * v * (b0 * d0 + b1 * d1 + b2 * d2)
    tau *= inverse
    return u, v, tau


@njit_no_refcount(forceinline=True)
def hit_color_gradient(
    flags: int, r: int, weight: float, rgb: Float32[np.ndarray, "r 3"]
) -> tuple[float, float, float]:
    """Return dL by the color of a hit of ray ``r``; a channel that was clamped at zero has none."""
    red = 0.0 if flags & RED_CLAMPED else weight * rgb[r, 0]
    green = 0.0 if flags & GREEN_CLAMPED else weight * rgb[r, 1]
    blue = 0.0 if flags & BLUE_CLAMPED else weight * rgb[r, 2]
    return red, green, blue


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def add_sh_gradient(
    sh_sum: Float64[np.ndarray, "16 3"],
    basis: Float64[np.ndarray, "16"],
    count: int,
    color_gradient: tuple[float, float, float],
) -> None:
    """Add dL by the first ``count`` harmonics."""
    for j in range(count):
        sh_sum[j, 0] += basis[j] * color_gradient[0]
        sh_sum[j, 1] += basis[j] * color_gradient[1]
        sh_sum[j, 2] += basis[j] * color_gradient[2]


@njit_no_refcount(forceinline=True)
def write_color_gradients(
    segment: int,
    sh_sum: Float64[np.ndarray, "16 3"],
    feature_sum: Float64[np.ndarray, " f"],
    out: GaussianGradientArrays,
) -> None:
    """Write a Gaussian's gradients by its harmonics and features; of degree 0 the sum lacks the harmonic."""
    factor = SH_C0 if out.sh.shape[1] == 1 else 1.0
    for j in range(out.sh.shape[1]):
        for channel in range(3):
            out.sh[segment, j, channel] = sh_sum[j, channel] * factor
    for f in range(out.features.shape[1]):
        out.features[segment, f] = feature_sum[f]


@njit_no_refcount(fastmath={"contract"})
def reduce_hits_chunk(
    first: int,
    last: int,
    scratch: tuple[Float64[np.ndarray, "16"], Float64[np.ndarray, "16 3"], Float64[np.ndarray, " f"]],
    backward: BackwardPass,
    gaussian_segments: GaussianSegments,
    hit_gradients: HitGradients,
    out: GaussianGradientArrays,
) -> None:
    """Write the gradients of the Gaussians ``first`` to ``last`` of the sorted hits.

    ``scratch`` has room for the harmonics, their gradients and those of the features.
    """
    basis, sh_sum, feature_sum = scratch
    rays, scene, limits = backward.rays, backward.scene, backward.limits
    parameters, output_gradients = backward.parameters, backward.output_gradients
    order, starts = gaussian_segments.order, gaussian_segments.starts
    means, quats, log_scales = parameters.means, parameters.quats, parameters.log_scales
    basis_count, feature_count = out.sh.shape[1], out.features.shape[1]
    for segment in range(first, last):
        i = gaussian_segments.ids[starts[segment]]
        # --- the frame, in float64 from the raw parameters: float32 axes would cost needles digits ---
        r1, r2, r3, s2, s3 = gaussian_frame(i, quats, log_scales)
        inv_s2, inv_s3 = 1.0 / s2, 1.0 / s3
        mean_x, mean_y, mean_z = np.float64(means[i, 0]), np.float64(means[i, 1]), np.float64(means[i, 2])
        axis_u = r2[0] * inv_s2, r2[1] * inv_s2, r2[2] * inv_s2
        axis_v = r3[0] * inv_s3, r3[1] * inv_s3, r3[2] * inv_s3
        # --- sums over its hits, as in GaussianMoments; then of weights and errors ---
        s_h = s_hu = s_hv = s_huu = s_hvv = s_huv = s_tau = s_tau_u = s_tau_v = 0.0
        s_n0 = s_n1 = s_n2 = s_m0 = s_m1 = s_m2 = 0.0
        s_w = s_error = 0.0
        sh_sum[:basis_count] = 0.0
        feature_sum[:] = 0.0
        for k in range(starts[segment], starts[segment + 1]):
            e = order[k]
            r = hit_gradients.ray_flags[e] & RAY_ID_MASK
            h, w = np.float64(hit_gradients.h_alpha[e]), np.float64(hit_gradients.weights[e])
            direction, origin = ray_direction(rays, r), ray_origin(rays, r)
            x, y, z = origin[0] - mean_x, origin[1] - mean_y, origin[2] - mean_z
            to_mean = -x, -y, -z
            u, v, tau = hit_in_frame(
                h, np.float64(hit_gradients.g_t[e]), (x, y, z), direction, r1, axis_u, axis_v
            )
            hu, hv = h * u, h * v
            s_h, s_hu, s_hv = s_h + h, s_hu + hu, s_hv + hv
            s_huu += hu * u
            s_hvv += hv * v
            s_huv += hu * v
            s_tau, s_tau_u, s_tau_v = s_tau + tau, s_tau_u + tau * u, s_tau_v + tau * v
            s_w += w
            s_error += w * output_gradients.ray_errors[r]
            grad_color = hit_color_gradient(hit_gradients.ray_flags[e], r, w, output_gradients.rgb)
            if basis_count == 1:  # the value of the basis comes in the end
                for channel in range(3):
                    sh_sum[0, channel] += grad_color[channel]
            else:
                view = eval_ray_view_basis(basis, basis_count, to_mean, direction, ray_t_view_origin(rays, r))
                add_sh_gradient(sh_sum, basis, basis_count, grad_color)
                write_basis_gradient(basis, scene.sh, i, basis_count, grad_color)
                m_x, m_y, m_z = mean_gradient(basis, basis_count, view)
                s_m0, s_m1, s_m2 = s_m0 + m_x, s_m1 + m_y, s_m2 + m_z
            if output_gradients.has_geometry:
                facing = w * facing_sign(to_mean, r1, limits)
                s_n0 += facing * output_gradients.normal[r, 0]
                s_n1 += facing * output_gradients.normal[r, 1]
                s_n2 += facing * output_gradients.normal[r, 2]
            for f in range(feature_count):
                feature_sum[f] += w * output_gradients.features[r, f]
        # --- the gradients ---
        moments = GaussianMoments(
            s_h, s_hu, s_hv, s_huu, s_huv, s_hvv, s_tau, s_tau_u, s_tau_v, s_n0, s_n1, s_n2, s_m0, s_m1, s_m2
        )
        write_geometry_gradients(segment, i, (r1, r2, r3, s2, s3), quats, scene.primitives, moments, out)
        write_color_gradients(segment, sh_sum, feature_sum, out)
        out.ids[segment], out.weights[segment], out.errors[segment] = i, s_w, s_error
        out.counts[segment] = starts[segment + 1] - starts[segment]


@kernel(fastmath={"contract"}, error_model="numpy")
def reduce_hits(
    backward: BackwardPass,
    gaussian_segments: GaussianSegments,
    chunk_bounds: Int64[np.ndarray, " c1"],
    counter: Int64[np.ndarray, "1"],
    hit_gradients: HitGradients,
    out: GaussianGradientArrays,
) -> None:
    """Sum the hits of each Gaussian and turn the sums into gradients of its raw parameters.

    Chunk c has the Gaussians ``chunk_bounds[c]`` to ``chunk_bounds[c + 1]``; ``counter`` holds one zero.
    """
    feature_count = out.features.shape[1]
    memory = np.empty(16), np.empty((16, 3)), np.empty(max(feature_count, 1))
    while True:
        chunk = atomic_fetch_next(counter.ctypes.data)
        if chunk >= len(chunk_bounds) - 1:
            break
        first, last = chunk_bounds[chunk], chunk_bounds[chunk + 1]
        reduce_hits_chunk(first, last, memory, backward, gaussian_segments, hit_gradients, out)
