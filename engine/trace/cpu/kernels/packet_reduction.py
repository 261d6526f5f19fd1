"""From the rows of moments of all packets to the gradients of each Gaussian.

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

from octasplat.engine.core.compilation import kernel
from octasplat.engine.trace.cpu.kernels.geometry_gradients import (
    GaussianMoments,
    gaussian_frame,
    write_geometry_gradients,
)
from octasplat.engine.trace.cpu.kernels.kernel_args import (
    BackwardPass,
    GaussianGradientArrays,
    GaussianSegments,
    RayArrays,
)
from octasplat.engine.trace.cpu.kernels.moment_rows import (
    BLUE,
    COUNT,
    ERROR,
    GREEN,
    GT,
    GTU,
    GTV,
    HU,
    HUU,
    HUUU,
    HUV,
    HV,
    HVV,
    HVVV,
    N_0,
    N_1,
    N_2,
    PACKET,
    RED,
    ROW_WORDS,
    H,
    MomentRows,
    W,
)
from octasplat.engine.trace.cpu.kernels.packet_candidates import PREFETCH_DISTANCE, PRIMITIVE_BYTES
from octasplat.engine.trace.cpu.kernels.rays import facing_sign, ray_origin
from octasplat.engine.trace.cpu.kernels.simd8_backward import accumulate_row
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
            # in the order of the packets: the sum does not depend on the threads
            total += weights[gaussian_segments.order[k]]
        out[segment] = total


class ReduceScratch(NamedTuple):
    """Memory of a thread: sums of a Gaussian's rows, of those with one origin, and harmonics."""

    sums: Float64[np.ndarray, "16"]
    origin_sums: Float64[np.ndarray, "16"]
    basis: Float64[np.ndarray, "16"]


@njit_no_refcount(forceinline=True)
def packet_origin(
    row: int, words: Int32[np.ndarray, "e 16"], rays: RayArrays, packets: Int64[np.ndarray, "p 2"]
) -> tuple[float, float, float]:
    """Return the origin of the packet that a row is of."""
    return ray_origin(rays, packets[words[row, PACKET], 0])


@njit_no_refcount(forceinline=True)
def sum_rows_of_origin(
    k: int,
    end: int,
    origin: tuple[float, float, float],
    order: Int32[np.ndarray, " e"],
    rays: RayArrays,
    packets: Int64[np.ndarray, "p 2"],
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
            grad_t = rows.geometry[row]
            gt, gtu, gtv = gt + grad_t[GT], gtu + grad_t[GTU], gtv + grad_t[GTV]
            t0, t1, t2 = t0 + grad_t[N_0], t1 + grad_t[N_1], t2 + grad_t[N_2]
        for f in range(len(features)):
            features[f] += rows.features[row, f]
        k += 1
        # origins compare by their bits
        if k == end or packet_origin(order[k], words, rays, packets) != origin:
            break
    return k, (gt, gtu, gtv), (t0, t1, t2)


@njit_no_refcount(fastmath={"contract"})
def reduce_packets_chunk(
    first: int,
    last: int,
    backward: BackwardPass,
    packets: Int64[np.ndarray, "p 2"],
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
    rays, parameters = backward.rays, backward.parameters
    scene, limits = backward.scene, backward.limits
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
            origin = packet_origin(order[k], words, rays, packets)
            k, (gt, gtu, gtv), (t0, t1, t2) = sum_rows_of_origin(
                k, end, origin, order, rays, packets, rows, here, out.features[place]
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
            # tau = (g_t t - h u (u + xa) - h v (v + xb)) / n0, summed; then times u and times v
            tau += (gt - huu - xa * hu - hvv - xb * hv) * inverse
            tau_u += (gtu - here[HUUU] - xa * huu - xb * huv) * inverse
            tau_v += (gtv - here[HVVV] - xa * huv - xb * hvv) * inverse
            # --- harmonics, and the mean through the direction of view ---
            grad_color = here[RED], here[GREEN], here[BLUE]
            view = eval_view_basis(basis, basis_count, x, y, z)
            accumulate_sh_gradient(out.sh, place, basis, basis_count, grad_color)
            if basis_count > 1:
                write_basis_gradient(basis, scene.sh, i, basis_count, grad_color)
                grad_x, grad_y, grad_z = mean_gradient(basis, basis_count, view)
                m0, m1, m2 = m0 + grad_x, m1 + grad_y, m2 + grad_z
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
    packets: Int64[np.ndarray, "p 2"],
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
    per_chunk = (len(segment_indices) + chunks - 1) // chunks  # rounded up; the last chunks may be empty
    while True:
        chunk = atomic_fetch_next(counter.ctypes.data)
        if chunk >= chunks:
            break
        first, last = chunk * per_chunk, min(len(segment_indices), (chunk + 1) * per_chunk)
        scratch = ReduceScratch(
            np.empty(ROW_WORDS, np.float64), np.empty(ROW_WORDS, np.float64), np.empty(16, np.float64)
        )
        reduce_packets_chunk(first, last, backward, packets, segments, segment_indices, rows, out, scratch)
