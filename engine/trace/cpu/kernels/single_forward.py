"""Forward passes for rays that come alone: Embree gathers hits, nearest first, and they are composited."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt64

from octasplat.engine.core.compilation import kernel
from octasplat.engine.trace.cpu.kernels.composite import Hit, composite, init_ray_state, write_ray_outputs
from octasplat.engine.trace.cpu.kernels.kernel_args import ForwardPass, PackedScene, RayArrays, TraceLimits
from octasplat.engine.trace.cpu.kernels.octagon_hit import (
    ALPHA_MAX,
    BUFFER_FULL,
    COUNT,
    HIT_ALPHA,
    HIT_ID,
    HIT_T,
    LAST_ID,
    LAST_T,
    NORMAL,
    PRIMITIVES_ADDRESS,
    PRUNE_BELOW,
    RAY_F64,
    RAY_TFAR,
    RAY_WORDS,
    T_BACKFACE_CULL,
    T_MAX,
    TRANSMITTANCE,
)
from octasplat.engine.trace.cpu.kernels.rays import (
    first_hit_index,
    ray_direction,
    ray_limits,
    ray_origin,
    ray_t_backface_cull,
)
from octasplat.engine.trace.kernels.native import (
    atomic_fetch_next,
    call_with_three_pointers,
    njit_no_refcount,
)

INT32_MAX = 2**31 - 1
T_NEAR_SCALE, T_FAR_SCALE = np.float32(0.999999), np.float32(1.000001)
"""Embree tests boxes in float32: it searches from a little before a distance to a little behind one."""


class EmbreeRayQuery(NamedTuple):
    """Addresses of a function of Embree and of a scene; for each chunk of rays, a ray and arguments.

    The columns of ``scratch`` are those of :mod:`octasplat.engine.trace.cpu.kernels.octagon_hit`. The arrays
    beside it are the same memory, viewed outside, as numba takes half a second to compile the views.
    """

    function: int
    scene: int
    scratch: Float32[np.ndarray, "c w"]
    scratch_i32: Int32[np.ndarray, "c w"]
    scratch_f64: Float64[np.ndarray, "c half"]
    scratch_u64: UInt64[np.ndarray, "c half"]
    arguments: UInt64[np.ndarray, "c 8"]


@njit_no_refcount()
def chunk_context(
    embree: EmbreeRayQuery, chunk: int, primitives: Float32[np.ndarray, "n 16"]
) -> tuple[
    Float32[np.ndarray, " words"],
    Int32[np.ndarray, " words"],
    Float32[np.ndarray, " words"],
    Int32[np.ndarray, " words"],
    Float64[np.ndarray, " words"],
]:
    """Return the ray of a chunk and its context, as words of each type; the context has the records."""
    ray, ray_i32 = embree.scratch[chunk], embree.scratch_i32[chunk]
    embree.scratch_u64[chunk, RAY_WORDS // 2 + PRIMITIVES_ADDRESS] = primitives.ctypes.data
    context_f64 = embree.scratch_f64[chunk, RAY_WORDS // 2 :]
    return ray, ray_i32, ray[RAY_WORDS:], ray_i32[RAY_WORDS:], context_f64


@njit_no_refcount()
def write_ray_query(
    ray: Float32[np.ndarray, " words"],
    ray_i32: Int32[np.ndarray, " words"],
    context_i32: Int32[np.ndarray, " words"],
    origin: tuple[float, float, float],
    direction: tuple[float, float, float],
    t_near: float,
    t_far: float,
) -> None:
    """Write the ray and the start of its context as Embree wants them."""
    for axis in range(3):
        ray[axis] = origin[axis]
        ray[4 + axis] = direction[axis]
    ray[3], ray[7], ray[RAY_TFAR] = t_near * T_NEAR_SCALE, np.float32(0.0), t_far * T_FAR_SCALE
    # mask -1 sees all geometry; ids and flags as rtcInit functions leave them
    ray_i32[9], ray_i32[10], ray_i32[11] = -1, 0, 0
    ray_i32[17], ray_i32[18], ray_i32[19] = -1, -1, -1
    context_i32[0], context_i32[1] = -1, -1


@njit_no_refcount(fastmath={"contract"})
def trace_rays_worker(
    embree: EmbreeRayQuery,
    forward: ForwardPass,
    ray_indices: Int64[np.ndarray, " i"],
    rays_per_chunk: int,
    counter: Int64[np.ndarray, "1"],
    basis: Float64[np.ndarray, " k"],
) -> None:
    """Trace the rays ``ray_indices``, in ascending order, until the ``counter`` has passed the last chunk.

    The hits of ray r are stored from ``first_place(r)`` on, or behind those of ray r - 1 where its chunk has
    it. A ray's result depends on nothing but the ray, so it is the same for every number of threads.
    ``basis`` has room for the harmonics.
    """
    rays, scene, limits = forward.rays, forward.scene, forward.limits
    chunk_count = (len(ray_indices) + rays_per_chunk - 1) // rays_per_chunk
    # Certainly behind the stop: T2 <= T / (eps1 (1 - alpha_max)), and the margin covers rounding.
    last_phase = limits.eps2 * (1.0 - limits.alpha_max) if limits.eps2 <= 1.0 else 1.0
    prune_below = 0.999 * limits.eps1 * last_phase
    while True:
        chunk = atomic_fetch_next(counter.ctypes.data)
        if chunk >= chunk_count:
            break
        ray, ray_i32, context, context_i32, context_f64 = chunk_context(embree, chunk, scene.primitives)
        context_f64[PRUNE_BELOW], context_f64[ALPHA_MAX] = prune_below, limits.alpha_max
        place, before = 0, -2  # no ray has number -1
        for s in range(chunk * rays_per_chunk, min(len(ray_indices), (chunk + 1) * rays_per_chunk)):
            r = ray_indices[s]
            if r != before + 1:
                place = first_hit_index(r, limits)
            before = r
            origin, direction = ray_origin(rays, r), ray_direction(rays, r)
            t_min, t_max = ray_limits(rays, r)
            for axis in range(3):
                context_f64[RAY_F64 + axis] = origin[axis]
                context_f64[RAY_F64 + 3 + axis] = direction[axis]
            front = init_ray_state(forward, r, place)
            context[LAST_T], context_i32[LAST_ID], context[T_MAX] = t_min, INT32_MAX, t_max
            context[T_BACKFACE_CULL] = ray_t_backface_cull(rays, r, limits)
            stop = not t_min < t_max  # a ray without length is not given to Embree
            while not stop:
                write_ray_query(ray, ray_i32, context_i32, origin, direction, context[LAST_T], t_max)
                context_i32[COUNT], context_i32[BUFFER_FULL] = 0, 0
                context_f64[TRANSMITTANCE] = front.t1
                call_with_three_pointers(
                    embree.function, embree.scene, ray.ctypes.data, embree.arguments[chunk].ctypes.data
                )
                gathered = context_i32[COUNT]
                # the buffer held all hits, or what it holds already ends the ray
                stop = context_i32[BUFFER_FULL] == 0 or context_f64[TRANSMITTANCE] < prune_below
                for k in range(gathered):
                    i = context_i32[HIT_ID + k]
                    record = scene.primitives[i]
                    hit = Hit(
                        i,
                        context[HIT_T + k],
                        np.float64(context[HIT_ALPHA + k]),
                        np.float64(record[NORMAL]),
                        np.float64(record[NORMAL + 1]),
                        np.float64(record[NORMAL + 2]),
                    )
                    front, ends = composite(front, hit, forward, r, origin, direction, basis)
                    if ends:
                        stop = True
                        break
                # go on behind the last hit gathered
                if not stop:
                    context[LAST_T] = context[HIT_T + gathered - 1]
                    context_i32[LAST_ID] = context_i32[HIT_ID + gathered - 1]
            write_ray_outputs(front, forward, r)
            place = front.next_hit_index


@kernel(error_model="numpy")
def trace_rays(
    embree: EmbreeRayQuery,
    forward: ForwardPass,
    ray_indices: Int64[np.ndarray, " i"],
    rays_per_chunk: int,
    counter: Int64[np.ndarray, "1"],
) -> None:
    """Run :func:`trace_rays_worker` with memory for the harmonics."""
    trace_rays_worker(embree, forward, ray_indices, rays_per_chunk, counter, np.empty(16, np.float64))


@kernel(_nrt=False, error_model="numpy", fastmath={"contract"})
def write_ray_transmittance(
    embree: EmbreeRayQuery,
    rays: RayArrays,
    scene: PackedScene,
    limits: TraceLimits,
    ray_indices: Int64[np.ndarray, " i"],
    rays_per_chunk: int,
    counter: Int64[np.ndarray, "1"],
    transmittance: Float32[np.ndarray, " r"],
) -> None:
    """Write the transmittance alone of the rays ``ray_indices``, 0 where it falls below eps1."""
    chunk_count = (len(ray_indices) + rays_per_chunk - 1) // rays_per_chunk
    while True:
        chunk = atomic_fetch_next(counter.ctypes.data)
        if chunk >= chunk_count:
            break
        ray, ray_i32, context, context_i32, context_f64 = chunk_context(embree, chunk, scene.primitives)
        context_f64[PRUNE_BELOW], context_f64[ALPHA_MAX] = limits.eps1, limits.alpha_max
        for s in range(chunk * rays_per_chunk, min(len(ray_indices), (chunk + 1) * rays_per_chunk)):
            r = ray_indices[s]
            origin, direction = ray_origin(rays, r), ray_direction(rays, r)
            for axis in range(3):
                context_f64[RAY_F64 + axis] = origin[axis]
                context_f64[RAY_F64 + 3 + axis] = direction[axis]
            context[LAST_T], context[T_MAX] = ray_limits(rays, r)
            context[T_BACKFACE_CULL] = ray_t_backface_cull(rays, r, limits)
            context_f64[TRANSMITTANCE] = 1.0
            if context[LAST_T] < context[T_MAX]:  # Embree's rays must not be inside out
                write_ray_query(ray, ray_i32, context_i32, origin, direction, context[LAST_T], context[T_MAX])
                call_with_three_pointers(
                    embree.function, embree.scene, ray.ctypes.data, embree.arguments[chunk].ctypes.data
                )
            left = context_f64[TRANSMITTANCE]
            transmittance[r] = 0.0 if left < limits.eps1 else left
