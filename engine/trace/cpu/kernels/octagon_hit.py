"""Embree's callbacks: the exact hit of a ray with an octagon, kept in a sorted buffer on the ray.

Records, boxes and the ray's scratch memory are raw float32 words laid out as the constants below say.
Geometry is computed in float64 from float32 parameters, so that far or grazing octagons keep their
precision and the order of hits does not depend on how the hierarchy was walked.
"""

import math

import numpy as np
from jaxtyping import Float32, Float64, Int32
from numba import carray, types

from octasplat.engine.core.compilation import device_function
from octasplat.engine.trace.kernels.native import (
    Address,
    float32_pointer,
    float64_pointer,
    int32_pointer,
    native_callback,
    uint64_pointer,
)

# --- record of a Gaussian: one cache line of 16 float32 ---
PRIMITIVE_WORDS = 16
MEAN, NORMAL, AXIS_U, AXIS_V = 0, 3, 6, 9  # m, r1, r2/s2, r3/s3
INNER_RADIUS, OPACITY = 12, 13  # apothem of the octagon in standard deviations; a

# --- scratch of a ray: RTCRayHit, then RTCRayQueryContext followed by our own state ---
RAY_WORDS = 32
RAY_TFAR = 8
HIT_BUFFER_SIZE = 64
"""Hits that one traversal gathers; a ray that needs more is traced on from the last one."""
COUNT, LAST_ID, LAST_T, BUFFER_FULL = 2, 3, 4, 5  # words of the context (0 and 1 are Embree's)
T_MAX, T_BACKFACE_CULL = 26, 27
PRIMITIVES_ADDRESS = 3  # as 64-bit word
TRANSMITTANCE, PRUNE_BELOW, ALPHA_MAX = 4, 5, 6  # as float64 words
RAY_F64 = 7  # origin and direction, six float64 words
HIT_T = 32
HIT_ID = HIT_T + HIT_BUFFER_SIZE
HIT_ALPHA = HIT_ID + HIT_BUFFER_SIZE
CONTEXT_WORDS = HIT_ALPHA + HIT_BUFFER_SIZE
SCRATCH_WORDS = RAY_WORDS + CONTEXT_WORDS

GRAZING_COSINE = 1e-6
"""A ray that makes a smaller cosine with the normal runs inside the plane and does not hit it."""
COS_22, SIN_22 = math.cos(math.pi / 8), math.sin(math.pi / 8)


@device_function(fastmath={"contract"})
def insert_hit(
    context_i32: Int32[np.ndarray, " words"],
    context_f32: Float32[np.ndarray, " words"],
    context_f64: Float64[np.ndarray, " words2"],
    t: float,
    gaussian_id: int,
    alpha: float,
) -> int:
    """Insert by (t, id) into the sorted buffer; drop hits that lie behind the ray's end. Return new count."""
    count = context_i32[COUNT]
    # --- make room: the farthest hit of a full buffer leaves, and no longer attenuates the ray ---
    if count == HIT_BUFFER_SIZE:
        context_f64[TRANSMITTANCE] /= 1.0 - np.float64(context_f32[HIT_ALPHA + HIT_BUFFER_SIZE - 1])
        slot = HIT_BUFFER_SIZE - 1
    else:
        slot = count
        count += 1
    # insertion from the back: most hits come nearly in order
    while slot > 0:
        t_before = context_f32[HIT_T + slot - 1]
        if t_before < t or (t_before == t and context_i32[HIT_ID + slot - 1] < gaussian_id):
            break
        context_f32[HIT_T + slot] = t_before
        context_i32[HIT_ID + slot] = context_i32[HIT_ID + slot - 1]
        context_f32[HIT_ALPHA + slot] = context_f32[HIT_ALPHA + slot - 1]
        slot -= 1
    context_f32[HIT_T + slot] = t
    context_i32[HIT_ID + slot] = gaussian_id
    context_f32[HIT_ALPHA + slot] = alpha
    transmittance = context_f64[TRANSMITTANCE] * (1.0 - np.float64(alpha))
    # Behind the hit that takes the ray below its threshold nothing is needed any more.
    while count > 1:
        before_last = transmittance / (1.0 - np.float64(context_f32[HIT_ALPHA + count - 1]))
        if before_last >= context_f64[PRUNE_BELOW]:
            break
        transmittance = before_last
        count -= 1
    context_f64[TRANSMITTANCE] = transmittance
    context_i32[COUNT] = count
    return count


@device_function(forceinline=True, fastmath={"contract"})
def intersect_plane(
    primitive: Float32[np.ndarray, "16"], context_f64: Float64[np.ndarray, " words2"]
) -> tuple[float, bool]:
    """Return distance along the ray at which it meets the Gaussian's plane; infinite where it runs inside it.

    And whether it meets it from behind.
    """
    nx, ny, nz = (
        np.float64(primitive[NORMAL]),
        np.float64(primitive[NORMAL + 1]),
        np.float64(primitive[NORMAL + 2]),
    )
    cosine = context_f64[RAY_F64 + 3] * nx + context_f64[RAY_F64 + 4] * ny + context_f64[RAY_F64 + 5] * nz
    if abs(cosine) < GRAZING_COSINE:
        return np.inf, False
    x = context_f64[RAY_F64] - primitive[MEAN]
    y = context_f64[RAY_F64 + 1] - primitive[MEAN + 1]
    z = context_f64[RAY_F64 + 2] - primitive[MEAN + 2]
    return -(x * nx + y * ny + z * nz) / cosine, cosine > 0.0  # t = <m - o, r1> / <d, r1>


@device_function(forceinline=True, fastmath={"contract"})
def eval_octagon(
    primitive: Float32[np.ndarray, "16"], context_f64: Float64[np.ndarray, " words2"], distance: float
) -> tuple[float, float, bool]:
    """Return the hit point on the plane in standard deviations, and whether it is inside the octagon."""
    x = context_f64[RAY_F64] - primitive[MEAN] + distance * context_f64[RAY_F64 + 3]
    y = context_f64[RAY_F64 + 1] - primitive[MEAN + 1] + distance * context_f64[RAY_F64 + 4]
    z = context_f64[RAY_F64 + 2] - primitive[MEAN + 2] + distance * context_f64[RAY_F64 + 5]
    u = x * primitive[AXIS_U] + y * primitive[AXIS_U + 1] + z * primitive[AXIS_U + 2]
    v = x * primitive[AXIS_V] + y * primitive[AXIS_V + 1] + z * primitive[AXIS_V + 2]
    abs_u, abs_v = abs(u), abs(v)
    # Edge normals stand at 22.5 + 45 k degrees; the absolute values map all eight to these two.
    farthest = max(abs_u * COS_22 + abs_v * SIN_22, abs_u * SIN_22 + abs_v * COS_22)
    return u, v, farthest <= primitive[INNER_RADIUS]


@device_function(forceinline=True, fastmath={"contract"})
def eval_alpha(
    primitive: Float32[np.ndarray, "16"], context_f64: Float64[np.ndarray, " words2"], u: float, v: float
) -> np.float32:
    """Return the alpha of the Gaussian at u, v, rounded to float32."""
    return np.float32(min(primitive[OPACITY] * math.exp(-0.5 * (u * u + v * v)), context_f64[ALPHA_MAX]))


@device_function(forceinline=True)
def callback_arguments(
    arguments: Address,
) -> tuple[
    np.int64,
    Int32[np.ndarray, " words"],
    Float32[np.ndarray, " words"],
    Float64[np.ndarray, " words2"],
    Float32[np.ndarray, " words"],
    Float32[np.ndarray, "16"],
]:
    """Return what Embree hands to a callback for one ray.

    The number of the Gaussian, the context as words of each type, the ray, and the Gaussian's record.
    """
    words = carray(arguments, 6)
    gaussian = np.int64(words[2] & np.uint64(0xFFFFFFFF))
    context_i32 = carray(int32_pointer(words[3]), CONTEXT_WORDS)
    context_f32 = carray(float32_pointer(words[3]), CONTEXT_WORDS)
    context_f64 = carray(float64_pointer(words[3]), CONTEXT_WORDS // 2)
    # the context's own words, behind the two of Embree's
    context_u64 = carray(uint64_pointer(words[3]), CONTEXT_WORDS // 2)
    ray = carray(float32_pointer(words[4]), RAY_WORDS)
    record = carray(
        float32_pointer(context_u64[PRIMITIVES_ADDRESS] + np.uint64(gaussian * PRIMITIVE_WORDS * 4)),
        PRIMITIVE_WORDS,
    )
    return gaussian, context_i32, context_f32, context_f64, ray, record


@native_callback(types.void(types.CPointer(types.uint64)), fastmath={"contract"})
def intersect_octagon(arguments: Address) -> None:
    """Intersect one ray (RTCIntersectFunctionN): exact plane hit, octagon test, alpha, insertion."""
    gaussian, context_i32, context_f32, context_f64, ray, record = callback_arguments(arguments)
    distance, behind = intersect_plane(record, context_f64)
    # compared in float32, the precision that hits are stored and ordered in
    t = np.float32(distance)
    if t > ray[RAY_TFAR] or t >= context_f32[T_MAX] or t < context_f32[LAST_T]:
        return
    # Traversal starts again at the last hit gathered: of equal distances only larger ids are new.
    if t == context_f32[LAST_T] and gaussian <= context_i32[LAST_ID]:
        return
    if behind and t < context_f32[T_BACKFACE_CULL]:
        return
    u, v, inside = eval_octagon(record, context_f64, distance)
    if not inside:
        return
    # a full buffer refuses what lies behind its last hit
    if context_i32[COUNT] == HIT_BUFFER_SIZE:
        t_last = context_f32[HIT_T + HIT_BUFFER_SIZE - 1]
        if t > t_last or (t == t_last and gaussian > context_i32[HIT_ID + HIT_BUFFER_SIZE - 1]):
            return
    alpha = eval_alpha(record, context_f64, u, v)
    count = insert_hit(context_i32, context_f32, context_f64, t, np.int32(gaussian), alpha)
    if count == HIT_BUFFER_SIZE:
        context_i32[BUFFER_FULL] = 1
    if count == HIT_BUFFER_SIZE or context_f64[TRANSMITTANCE] < context_f64[PRUNE_BELOW]:
        # Slightly beyond the last kept hit: boxes are tested in float32 and ties are settled by id.
        ray[RAY_TFAR] = context_f32[HIT_T + count - 1] * np.float32(1.000001)


@native_callback(types.void(types.CPointer(types.uint64)), fastmath={"contract"})
def attenuate_by_octagon(arguments: Address) -> None:
    """Attenuate one ray (RTCOccludedFunctionN) by a Gaussian until too little transmittance is left."""
    _, _, context_f32, context_f64, ray, record = callback_arguments(arguments)
    distance, behind = intersect_plane(record, context_f64)
    t = np.float32(distance)
    if t <= context_f32[LAST_T] or t >= context_f32[T_MAX] or (behind and t < context_f32[T_BACKFACE_CULL]):
        return
    u, v, inside = eval_octagon(record, context_f64, distance)
    if inside:
        context_f64[TRANSMITTANCE] *= 1.0 - np.float64(eval_alpha(record, context_f64, u, v))
        if context_f64[TRANSMITTANCE] < context_f64[PRUNE_BELOW]:
            ray[RAY_TFAR] = -np.inf  # Embree: a hit, go no further


@native_callback(types.void(types.CPointer(types.uint64)))
def octagon_bounds(arguments: Address) -> None:
    """Copy the prepared bounding box of a Gaussian (RTCBoundsFunction)."""
    words = carray(arguments, 3)
    gaussian = np.uint64(words[1] & np.uint64(0xFFFFFFFF))
    box = carray(float32_pointer(words[0] + gaussian * np.uint64(24)), 6)
    out = carray(float32_pointer(words[2]), 8)
    for axis in range(3):
        out[axis] = box[axis]
        out[4 + axis] = box[3 + axis]
