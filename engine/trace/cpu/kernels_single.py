"""The forward pass: gather sorted hits with Embree, composite them front to back."""

import numpy as np
from numba import njit, prange

from engine.trace.cpu.kernels_hit import (
    ALPHA_MAX,
    BUFFER_FULL,
    COUNT,
    HIT_ALPHA,
    HIT_ID,
    HIT_T,
    LAST_ID,
    LAST_T,
    NORMAL,
    PRUNE_BELOW,
    RAY64,
    RAY_TFAR,
    RAY_WORDS,
    RECORDS,
    TRANSMITTANCE,
)
from engine.trace.cpu.kernels_sh import colour, write_basis
from engine.trace.kernels_native import call_with_three_pointers, next_from_counter

INT32_MAX = 2**31 - 1


@njit(cache=True, parallel=True, fastmath={"contract"})
def trace_rays(
    intersect1, scene, scratch, call_arguments, origins, directions,
    records, sh, features,
    eps1, eps2, t_min, alpha_max, max_hits, rays_per_chunk, workers, counter,
    rgb, transmittance, depth_sum, depth_median, normal_sum, feature_sum, counts,
    record_hits, starts, hit_ids, hit_alphas, hit_ts, hit_rgb,
):  # fmt: skip
    """Trace all rays; chunk c owns scratch row c and the hit storage from c * rays_per_chunk * max_hits on.

    ``eps2`` > 1 means the single-threshold stop. One ray's result depends on nothing but the ray, so it is
    the same for every number of threads. ``counter`` holds one zero.
    """
    ray_count = origins.shape[0]
    chunk_count = (ray_count + rays_per_chunk - 1) // rays_per_chunk
    records_address = records.ctypes.data
    # Certainly behind the stop: T2 <= T / (eps1 (1 - alpha_max)), and the margin covers rounding.
    prune_below = 0.999 * eps1 * (eps2 * (1.0 - alpha_max) if eps2 <= 1.0 else 1.0)
    basis_count = sh.shape[1]
    feature_count = features.shape[1]
    for _worker in prange(workers):
        basis = np.empty(16, np.float64)
        while True:
            chunk = next_from_counter(counter.ctypes.data)
            if chunk >= chunk_count:
                break
            ray_f32 = scratch[chunk]
            ray_i32 = ray_f32.view(np.int32)
            context_i32, context_f32 = ray_i32[RAY_WORDS:], ray_f32[RAY_WORDS:]
            context_f64, context_u64 = context_f32.view(np.float64), context_f32.view(np.uint64)
            context_u64[RECORDS] = records_address
            context_f64[PRUNE_BELOW] = prune_below
            context_f64[ALPHA_MAX] = alpha_max
            position = chunk * rays_per_chunk * max_hits
            for r in range(chunk * rays_per_chunk, min(ray_count, (chunk + 1) * rays_per_chunk)):
                for axis in range(3):
                    context_f64[RAY64 + axis] = origins[r, axis]
                    context_f64[RAY64 + 3 + axis] = directions[r, axis]
                dx, dy, dz = context_f64[RAY64 + 3], context_f64[RAY64 + 4], context_f64[RAY64 + 5]
                write_basis(basis, basis_count, dx, dy, dz)
                t1, t2 = 1.0, 1.0
                second_phase = False
                red = green = blue = depth = 0.0
                normal_x = normal_y = normal_z = 0.0
                median = np.float32(0.0)
                feature_sum[r, :] = 0.0
                hits = 0
                t_near = np.float32(t_min)
                context_f32[LAST_T], context_i32[LAST_ID] = t_near, INT32_MAX
                starts[r] = position
                while True:
                    for axis in range(3):
                        ray_f32[axis] = origins[r, axis]
                        ray_f32[4 + axis] = directions[r, axis]
                    ray_f32[3], ray_f32[7], ray_f32[RAY_TFAR] = t_near, np.float32(0.0), np.float32(np.inf)
                    ray_i32[9], ray_i32[10], ray_i32[11] = -1, 0, 0
                    ray_i32[17], ray_i32[18], ray_i32[19] = -1, -1, -1
                    context_i32[0], context_i32[1] = -1, -1
                    context_i32[COUNT], context_i32[BUFFER_FULL] = 0, 0
                    context_f64[TRANSMITTANCE] = t1
                    call_with_three_pointers(
                        intersect1, scene, ray_f32.ctypes.data, call_arguments[chunk].ctypes.data
                    )
                    gathered = context_i32[COUNT]
                    stop = context_i32[BUFFER_FULL] == 0 or context_f64[TRANSMITTANCE] < prune_below
                    for k in range(gathered):
                        i = context_i32[HIT_ID + k]
                        t = context_f32[HIT_T + k]
                        alpha = np.float64(context_f32[HIT_ALPHA + k])
                        weight = alpha * t1
                        c_red, c_green, c_blue = colour(sh[i], basis)
                        red += weight * c_red
                        green += weight * c_green
                        blue += weight * c_blue
                        depth += weight * t
                        record = records[i]
                        n_x, n_y, n_z = record[NORMAL], record[NORMAL + 1], record[NORMAL + 2]
                        facing = -weight if dx * n_x + dy * n_y + dz * n_z > 0.0 else weight
                        normal_x += facing * n_x
                        normal_y += facing * n_y
                        normal_z += facing * n_z
                        for f in range(feature_count):
                            feature_sum[r, f] += np.float32(weight * features[i, f])
                        if t1 > 0.5 and t1 * (1.0 - alpha) <= 0.5:
                            median = t
                        if record_hits:
                            hit_ids[position] = i
                            hit_alphas[position] = np.float32(alpha)
                            hit_ts[position] = t
                            hit_rgb[position, 0] = c_red
                            hit_rgb[position, 1] = c_green
                            hit_rgb[position, 2] = c_blue
                            position += 1
                        hits += 1
                        t1 *= 1.0 - alpha
                        if second_phase:
                            t2 *= 1.0 - alpha
                        elif t1 < eps1:
                            second_phase = True
                        if (second_phase and t2 < eps2) or hits >= max_hits:
                            stop = True
                            break
                    if stop:
                        break
                    last = HIT_T + gathered - 1
                    context_f32[LAST_T], context_i32[LAST_ID] = (
                        context_f32[last],
                        context_i32[HIT_ID + gathered - 1],
                    )
                    t_near = max(np.float32(t_min), context_f32[last] * np.float32(0.999999))
                counts[r] = hits
                rgb[r, 0], rgb[r, 1], rgb[r, 2] = red, green, blue
                transmittance[r] = t1
                depth_sum[r] = depth
                depth_median[r] = median
                normal_sum[r, 0], normal_sum[r, 1], normal_sum[r, 2] = normal_x, normal_y, normal_z
