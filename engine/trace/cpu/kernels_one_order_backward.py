"""The backward pass for packets whose rays see their Gaussians in one order.

Each Gaussian of a packet gets a row of moments as in
:mod:`octasplat.engine.trace.cpu.kernels_packet_backward`, which sums them by Gaussian. Rays go back from what
they have left in the end; float32 is enough, as what lies behind is summed from the back.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from octasplat.engine.compilation import kernel
from octasplat.engine.trace.cpu.kernels_one_order import aligned_rows, group_bits, write_ray_rows
from octasplat.engine.trace.cpu.kernels_packet_backward import PACKET, RED, ROW_WORDS, W
from octasplat.engine.trace.cpu.kernels_sixteen import (
    BACK_ROWS,
    BEHIND,
    BY_RED,
    COLOUR,
    ERROR,
    GROUPS,
    LEFT_BEHIND,
    LINE,
    MOMENTS,
    RAY_ROWS,
    RAYS,
    SIXTEEN,
    add_up,
    replay_group,
)
from octasplat.engine.trace.kernels_native import lean, next_from_counter


class ViewBack(NamedTuple):
    """Memory of a thread for a packet, see :mod:`octasplat.engine.trace.cpu.kernels_sixteen`."""

    rays: Float32[np.ndarray, "5 64"]
    back: Float32[np.ndarray, "6 64"]
    moments: Float32[np.ndarray, "14 16"]


@lean(fastmath={"contract"})
def replay_packet(packet, rays, packets, kept, limits, g, rows, view):
    """Write the rows of one packet."""
    first, last = packets[packet, 0], packets[packet, 1]
    start, base, back = kept.starts[packet], rows.firsts[packet], view.back
    words, alpha_max = rows.sums.view(np.int32), np.float32(limits.alpha_max)
    rays_at, back_at, moments_at = view.rays.ctypes.data, back.ctypes.data, view.moments.ctypes.data
    write_ray_rows(rays, first, last, kept.frames[packet], view.rays)
    back[:, :] = np.float32(0.0)
    for r in range(first, last):
        k = r - first
        for channel in range(3):
            back[BY_RED + channel, k] = g.rgb[r, channel]
        back[ERROR, k] = g.ray_errors[r]
        back[BEHIND, k], back[LEFT_BEHIND, k] = g.transmittance[r] * kept.left[r], kept.left[r]
    for k in range(kept.counts[packet] - 1, -1, -1):
        line_at = kept.lines.ctypes.data + (start + k) * (LINE * 4)
        view.moments[:, :] = np.float32(0.0)
        for group in range(GROUPS):
            here = group_bits(kept.bits[start + k], group)
            if here != 0:
                replay_group(line_at, rays_at, back_at, moments_at, group, here, alpha_max)
        row = base + k
        add_up(moments_at, rows.sums.ctypes.data + row * (ROW_WORDS * 4))
        rows.ids[row], words[row, PACKET] = kept.ids[start + k], packet
        rows.weights[row] = rows.sums[row, W]
        for channel in range(3):  # a colour clamped at zero gets no gradient
            if kept.lines[start + k, COLOUR + channel] <= 0.0:
                rows.sums[row, RED + channel] = np.float32(0.0)


@kernel(error_model="numpy")
def replay_one_order(rays, packets, kept, limits, g, counter, rows):
    """Replay packets until the ``counter`` has passed the last."""
    view = ViewBack(
        aligned_rows(RAY_ROWS, RAYS), aligned_rows(BACK_ROWS, RAYS), aligned_rows(MOMENTS, SIXTEEN)
    )
    while True:
        packet = next_from_counter(counter.ctypes.data)
        if packet >= len(packets):
            break
        replay_packet(packet, rays, packets, kept, limits, g, rows, view)
