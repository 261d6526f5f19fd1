"""Compositing of one hit into the state of a single ray."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from octasplat.engine.trace.cpu.kernels.kernel_args import ForwardPass
from octasplat.engine.trace.cpu.kernels.octagon_hit import MEAN
from octasplat.engine.trace.cpu.kernels.rays import facing_sign, ray_t_view_origin
from octasplat.engine.trace.cpu.kernels.spherical_harmonics import eval_color, eval_ray_view_basis
from octasplat.engine.trace.kernels.native import njit_no_refcount


class RayState(NamedTuple):
    """State of a ray while it is traced; sums are over the hits so far, each times its weight.

    ``t1`` is the transmittance, ``t2`` that of the second phase, which begins where ``t1`` falls below eps1
    (Algorithm 1 of RaySplats). ``next_hit_index`` is where the next hit is stored.
    """

    t1: float
    t2: float
    second_phase: bool
    red: float
    green: float
    blue: float
    depth: float
    normal_x: float
    normal_y: float
    normal_z: float
    depth_median: float | np.float32
    hit_count: int
    next_hit_index: int


class Hit(NamedTuple):
    """A Gaussian on a ray: its id, the distance (float32), alpha and the plane's normal."""

    gaussian: int
    t: float
    alpha: float
    normal_x: float
    normal_y: float
    normal_z: float


@njit_no_refcount(forceinline=True)
def init_ray_state(forward: ForwardPass, r: int, first_hit_index: int) -> RayState:
    """Return the state of ray ``r`` before its first hit; its hits are stored from ``first_hit_index`` on."""
    for f in range(forward.scene.features.shape[1]):
        forward.out.features[r, f] = np.float32(0.0)
    if forward.is_recording:
        forward.hits.starts[r] = first_hit_index
    return RayState(1.0, 1.0, False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.float32(0.0), 0, first_hit_index)


@njit_no_refcount(forceinline=True, fastmath={"contract"})
def composite(
    state: RayState,
    hit: Hit,
    forward: ForwardPass,
    r: int,
    origin: tuple[float, float, float],
    direction: tuple[float, float, float],
    basis: Float64[np.ndarray, " k"],
) -> tuple[RayState, bool]:
    """Return the ray ``r`` behind ``hit``, and whether it ends there.

    The hit is stored if the pass is recording. ``basis`` is room for harmonics.
    """
    i, t, alpha = hit.gaussian, hit.t, hit.alpha
    record = forward.scene.primitives[i]
    to_mean = record[MEAN] - origin[0], record[MEAN + 1] - origin[1], record[MEAN + 2] - origin[2]
    eval_ray_view_basis(
        basis, forward.scene.sh.shape[1], to_mean, direction, ray_t_view_origin(forward.rays, r)
    )
    weight = alpha * state.t1  # w_k = alpha_k T_k
    red, green, blue = eval_color(forward.scene.sh, i, basis)
    facing = weight * facing_sign(to_mean, (hit.normal_x, hit.normal_y, hit.normal_z), forward.limits)
    for f in range(forward.scene.features.shape[1]):
        forward.out.features[r, f] += np.float32(weight * forward.scene.features[i, f])
    t1 = state.t1 * (1.0 - alpha)  # T_(k+1) = T_k (1 - alpha_k)
    if forward.is_recording:
        hits = forward.hits
        hits.ids[state.next_hit_index] = i
        hits.alphas[state.next_hit_index] = np.float32(alpha)
        hits.distances[state.next_hit_index] = t
        hits.rgb[state.next_hit_index, 0] = red
        hits.rgb[state.next_hit_index, 1] = green
        hits.rgb[state.next_hit_index, 2] = blue
    t2, second_phase = state.t2, state.second_phase
    # the hit that crosses eps1 still belongs to the first phase
    if second_phase:
        t2 *= 1.0 - alpha
    elif t1 < forward.limits.eps1:
        second_phase = True
    count = state.hit_count + 1
    ends = (second_phase and t2 < forward.limits.eps2) or count >= forward.limits.max_hits
    behind = RayState(
        t1,
        t2,
        second_phase,
        state.red + weight * red,
        state.green + weight * green,
        state.blue + weight * blue,
        state.depth + weight * t,
        state.normal_x + facing * hit.normal_x,
        state.normal_y + facing * hit.normal_y,
        state.normal_z + facing * hit.normal_z,
        # the distance at which T falls to one half
        t if state.t1 > 0.5 and t1 <= 0.5 else state.depth_median,
        count,
        state.next_hit_index + 1,
    )
    return behind, ends


@njit_no_refcount(forceinline=True)
def write_ray_outputs(state: RayState, forward: ForwardPass, r: int) -> None:
    """Write the outputs of ray ``r``."""
    out = forward.out
    out.counts[r] = state.hit_count
    out.rgb[r, 0], out.rgb[r, 1], out.rgb[r, 2] = state.red, state.green, state.blue
    out.transmittance[r] = state.t1
    out.depth_sum[r] = state.depth
    out.depth_median[r] = state.depth_median
    out.normal[r, 0], out.normal[r, 1], out.normal[r, 2] = state.normal_x, state.normal_y, state.normal_z
