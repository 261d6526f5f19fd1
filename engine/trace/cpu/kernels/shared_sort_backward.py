"""The backward pass for packets whose rays see their Gaussians in one order.

Each Gaussian of a packet gets a row of moments as in
:mod:`octasplat.engine.trace.cpu.kernels.moment_rows`, which are summed by Gaussian. Rays go back from what
they have left in the end; float32 is enough, as what lies behind is summed from the back.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int64

from octasplat.engine.core.compilation import kernel
from octasplat.engine.trace.cpu.kernels.kernel_args import BackwardPass, SharedSortHits
from octasplat.engine.trace.cpu.kernels.moment_rows import PACKET, RED, ROW_WORDS, MomentRows, W
from octasplat.engine.trace.cpu.kernels.rays import next_packet
from octasplat.engine.trace.cpu.kernels.shared_sort import allocate_aligned_rows, group_lanes, write_ray_rows
from octasplat.engine.trace.cpu.kernels.simd16 import (
    BACKWARD_ROWS,
    COLOR,
    ERROR,
    GRAD_BEHIND,
    GRAD_RED,
    GROUP_SIZE,
    GROUPS,
    MOMENTS,
    PACKET_PRIMITIVE_WORDS,
    PACKET_RAYS,
    RAY_ROWS,
    TRANSMITTANCE_BEHIND,
    backward_group16,
    reduce_moments,
)
from octasplat.engine.trace.kernels.native import njit_no_refcount


class SharedSortBackwardScratch(NamedTuple):
    """Memory of a thread for a packet, see :mod:`octasplat.engine.trace.cpu.kernels.simd16`."""

    ray_rows: Float32[np.ndarray, "5 64"]
    backward_rows: Float32[np.ndarray, "6 64"]
    moments: Float32[np.ndarray, "14 16"]


@njit_no_refcount(fastmath={"contract"})
def backward_packet_shared_sort(
    packet: int,
    backward: BackwardPass,
    packets: Int64[np.ndarray, "p 2"],
    packet_hits: SharedSortHits,
    rows: MomentRows,
    scratch: SharedSortBackwardScratch,
) -> None:
    """Write the rows of one packet."""
    first, last = packets[packet, 0], packets[packet, 1]
    start, base, back = packet_hits.starts[packet], rows.firsts[packet], scratch.backward_rows
    words, alpha_max = rows.sums.view(np.int32), np.float32(backward.limits.alpha_max)
    output_gradients = backward.output_gradients
    rays_at, back_at, moments_at = scratch.ray_rows.ctypes.data, back.ctypes.data, scratch.moments.ctypes.data
    write_ray_rows(backward.rays, first, last, packet_hits.frames[packet], scratch.ray_rows)
    back[:, :] = np.float32(0.0)
    for r in range(first, last):
        k = r - first
        for channel in range(3):
            back[GRAD_RED + channel, k] = output_gradients.rgb[r, channel]
        # what lies behind the last hit: the background through the final transmittance
        back[ERROR, k] = output_gradients.ray_errors[r]
        back[GRAD_BEHIND, k], back[TRANSMITTANCE_BEHIND, k] = (
            output_gradients.transmittance[r] * packet_hits.transmittance[r],
            packet_hits.transmittance[r],
        )
    # --- back to front over the packet's shared order ---
    for k in range(packet_hits.counts[packet] - 1, -1, -1):
        line_at = packet_hits.packet_primitives.ctypes.data + (start + k) * (PACKET_PRIMITIVE_WORDS * 4)
        scratch.moments[:, :] = np.float32(0.0)
        for group in range(GROUPS):
            here = group_lanes(packet_hits.ray_masks[start + k], group)
            if here != 0:
                backward_group16(line_at, rays_at, back_at, moments_at, group, here, alpha_max)
        row = base + k
        reduce_moments(moments_at, rows.sums.ctypes.data + row * (ROW_WORDS * 4))
        rows.ids[row], words[row, PACKET] = packet_hits.ids[start + k], packet
        rows.weights[row] = rows.sums[row, W]
        for channel in range(3):  # a color clamped at zero gets no gradient
            if packet_hits.packet_primitives[start + k, COLOR + channel] <= 0.0:
                rows.sums[row, RED + channel] = np.float32(0.0)


@kernel(error_model="numpy")
def backward_packets_shared_sort(
    backward: BackwardPass,
    packets: Int64[np.ndarray, "p 2"],
    packet_hits: SharedSortHits,
    counter: Int64[np.ndarray, "1"],
    rows: MomentRows,
) -> None:
    """Replay packets until the ``counter`` has passed the last."""
    view = SharedSortBackwardScratch(
        allocate_aligned_rows(RAY_ROWS, PACKET_RAYS),
        allocate_aligned_rows(BACKWARD_ROWS, PACKET_RAYS),
        allocate_aligned_rows(MOMENTS, GROUP_SIZE),
    )
    while True:
        packet, _first, _last = next_packet(counter, packets)
        if packet < 0:
            break
        backward_packet_shared_sort(packet, backward, packets, packet_hits, rows, view)
