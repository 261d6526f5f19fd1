"""What a hit does to a ray that is followed alone."""

from typing import NamedTuple

import numpy as np

from octasplat.engine.trace.cpu.kernels_hit import MEAN
from octasplat.engine.trace.cpu.kernels_rays import ray_viewer, side_shown
from octasplat.engine.trace.cpu.kernels_sh import colour, write_ray_view
from octasplat.engine.trace.kernels_native import lean


class Front(NamedTuple):
    """A ray as far as it has been followed; sums are over the hits so far, each times its weight.

    ``t1`` is the transmittance, ``t2`` that of the second phase, which begins where ``t1`` falls below eps1
    (Algorithm 1 of RaySplats). ``place`` is where the next hit is stored.
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
    median: float
    hits: int
    place: int


class Hit(NamedTuple):
    """A Gaussian on a ray: its id, the distance (float32), alpha and the plane's normal."""

    gaussian: int
    t: float
    alpha: float
    normal_x: float
    normal_y: float
    normal_z: float


@lean(forceinline=True)
def begin(forward, r, place):
    """Ray ``r`` before its first hit; its hits will be stored from ``place`` on."""
    for f in range(forward.scene.features.shape[1]):
        forward.out.features[r, f] = np.float32(0.0)
    if forward.recording:
        forward.hits.starts[r] = place
    return Front(1.0, 1.0, False, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.float32(0.0), 0, place)


@lean(forceinline=True, fastmath={"contract"})
def composite(front, hit, forward, r, origin, direction, basis):
    """The ray ``r`` behind ``hit``, and whether it ends there.

    The hit is stored if the pass is recording. ``basis`` is room for harmonics.
    """
    i, t, alpha = hit.gaussian, hit.t, hit.alpha
    record = forward.scene.records[i]
    to_mean = record[MEAN] - origin[0], record[MEAN + 1] - origin[1], record[MEAN + 2] - origin[2]
    write_ray_view(basis, forward.scene.sh.shape[1], to_mean, direction, ray_viewer(forward.rays, r))
    weight = alpha * front.t1
    red, green, blue = colour(forward.scene.sh, i, basis)
    facing = weight * side_shown(to_mean, (hit.normal_x, hit.normal_y, hit.normal_z), forward.limits)
    for f in range(forward.scene.features.shape[1]):
        forward.out.features[r, f] += np.float32(weight * forward.scene.features[i, f])
    t1 = front.t1 * (1.0 - alpha)
    if forward.recording:
        hits = forward.hits
        hits.ids[front.place] = i
        hits.alphas[front.place] = np.float32(alpha)
        hits.distances[front.place] = t
        hits.rgb[front.place, 0] = red
        hits.rgb[front.place, 1] = green
        hits.rgb[front.place, 2] = blue
    t2, second_phase = front.t2, front.second_phase
    if second_phase:
        t2 *= 1.0 - alpha
    elif t1 < forward.limits.eps1:
        second_phase = True
    count = front.hits + 1
    ends = (second_phase and t2 < forward.limits.eps2) or count >= forward.limits.max_hits
    behind = Front(
        t1,
        t2,
        second_phase,
        front.red + weight * red,
        front.green + weight * green,
        front.blue + weight * blue,
        front.depth + weight * t,
        front.normal_x + facing * hit.normal_x,
        front.normal_y + facing * hit.normal_y,
        front.normal_z + facing * hit.normal_z,
        t if front.t1 > 0.5 and t1 <= 0.5 else front.median,
        count,
        front.place + 1,
    )
    return behind, ends


@lean(forceinline=True)
def finish(front, forward, r):
    """Write the outputs of ray ``r``."""
    out = forward.out
    out.counts[r] = front.hits
    out.rgb[r, 0], out.rgb[r, 1], out.rgb[r, 2] = front.red, front.green, front.blue
    out.transmittance[r] = front.t1
    out.depth_sum[r] = front.depth
    out.depth_median[r] = front.median
    out.normal[r, 0], out.normal[r, 1], out.normal[r, 2] = front.normal_x, front.normal_y, front.normal_z
