"""Access to single rays and vectors of batches, where one origin, limit or viewer may stand for all."""

import math

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.trace.cpu.kernels.kernel_args import OutputGradientArrays, RayArrays, TraceLimits
from octasplat.engine.trace.kernels.native import atomic_fetch_next, njit_no_refcount

HIT_PADDING = 8
"""Places for hits beyond the most that a ray can have, as they are written eight at a time."""


@njit_no_refcount(forceinline=True)
def ray_origin(rays: RayArrays, r: int) -> tuple[float, float, float]:
    """Return origin of ray ``r`` in float64."""
    o = r if len(rays.origins) > 1 else 0
    return np.float64(rays.origins[o, 0]), np.float64(rays.origins[o, 1]), np.float64(rays.origins[o, 2])


@njit_no_refcount(forceinline=True)
def ray_direction(rays: RayArrays, r: int) -> tuple[float, float, float]:
    """Return direction of ray ``r`` in float64."""
    return (
        np.float64(rays.directions[r, 0]),
        np.float64(rays.directions[r, 1]),
        np.float64(rays.directions[r, 2]),
    )


@njit_no_refcount(forceinline=True)
def ray_slopes(rays: RayArrays, r: int, frame: Float64[np.ndarray, "15"]) -> tuple[float, float, float]:
    """Return slopes a and b of ray ``r`` in a packet's ``frame``, and its length over its way along the axis.

    The frame begins with the axis, e and f; the direction is axis + a e + b f over the third number.
    """
    d0, d1, d2 = ray_direction(rays, r)
    per_axis = 1.0 / (d0 * frame[0] + d1 * frame[1] + d2 * frame[2])
    return (
        (d0 * frame[3] + d1 * frame[4] + d2 * frame[5]) * per_axis,
        (d0 * frame[6] + d1 * frame[7] + d2 * frame[8]) * per_axis,
        per_axis,
    )


@njit_no_refcount(forceinline=True)
def primitive_vector(primitive: Float32[np.ndarray, "16"], offset: int) -> tuple[float, float, float]:
    """Return three numbers of a primitive in float64."""
    return np.float64(primitive[offset]), np.float64(primitive[offset + 1]), np.float64(primitive[offset + 2])


@njit_no_refcount(forceinline=True)
def ray_limits(rays: RayArrays, r: int) -> tuple[float, float]:
    """Return between which distances ray ``r`` sees; a single limit stands for all rays."""
    return rays.t_min[r if len(rays.t_min) > 1 else 0], rays.t_max[r if len(rays.t_max) > 1 else 0]


@njit_no_refcount(forceinline=True)
def ray_t_view_origin(rays: RayArrays, r: int) -> float:
    """Return where on ray ``r`` its viewer stands; a single one stands for all rays."""
    return np.float64(rays.t_view_origin[r if len(rays.t_view_origin) > 1 else 0])


@njit_no_refcount(forceinline=True)
def ray_t_backface_cull(rays: RayArrays, r: int, limits: TraceLimits) -> np.float32:
    """Return up to where ray ``r`` passes Gaussians that it meets from behind."""
    if limits.flip_normal_cos == 0.0:  # normals have no side
        return np.float32(0.0)
    return rays.t_backface_cull[r if len(rays.t_backface_cull) > 1 else 0]


@njit_no_refcount(forceinline=True)
def facing_sign(
    to_mean: tuple[float, float, float], normal: tuple[float, float, float], limits: TraceLimits
) -> float:
    """Return 1, or -1 where ``normal`` is flipped towards the viewer.

    See :class:`octasplat.engine.trace.protocol.TraceSettings`.

    ``to_mean`` leads from the origin of a ray to the Gaussian's mean. A ray that meets a Gaussian in front
    of its origin does so from the side on which the origin lies.
    """
    x, y, z = to_mean
    along = x * normal[0] + y * normal[1] + z * normal[2]
    if along <= 0.0:
        return 1.0
    beyond = limits.flip_normal_cos
    # without a threshold every normal is turned towards the origin
    return -1.0 if beyond == 0.0 or along > beyond * math.sqrt(x * x + y * y + z * z) else 1.0


@njit_no_refcount(forceinline=True)
def first_hit_index(r: int, limits: TraceLimits) -> int:
    """Return where the hits of ray ``r`` may be stored from: each ray before it has room for its own."""
    return r * (limits.max_hits + HIT_PADDING)


@njit_no_refcount(forceinline=True)
def geometry_gradient(
    output_gradients: OutputGradientArrays, r: int
) -> tuple[float, float, tuple[float, float, float]]:
    """Return the gradients by the summed depth, the median depth and the normal of ray ``r`` in float64."""
    if not output_gradients.has_geometry:
        return 0.0, 0.0, (0.0, 0.0, 0.0)
    normal = output_gradients.normal
    return (
        np.float64(output_gradients.depth_sum[r]),
        np.float64(output_gradients.depth_median[r]),
        (np.float64(normal[r, 0]), np.float64(normal[r, 1]), np.float64(normal[r, 2])),
    )


@njit_no_refcount(forceinline=True)
def next_packet(counter: Int64[np.ndarray, "1"], packets: Int64[np.ndarray, "p 2"]) -> tuple[int, int, int]:
    """Return the number of the packet that is next by the ``counter``, its first ray and the one behind it.

    The number is -1 where none is left.
    """
    packet = atomic_fetch_next(counter.ctypes.data)
    if packet >= len(packets):
        return -1, 0, 0
    return packet, packets[packet, 0], packets[packet, 1]
