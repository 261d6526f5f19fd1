"""The transmittance of packets of rays alone: nothing is sorted, no color is read."""

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.compilation import kernel
from octasplat.engine.trace.cpu.kernels.kernel_args import (
    BvhArrays,
    Candidates,
    PackedScene,
    RayArrays,
    TraceLimits,
)
from octasplat.engine.trace.cpu.kernels.packet_bvh import WIDTH
from octasplat.engine.trace.cpu.kernels.packet_candidates import (
    INITIAL_CAPACITY,
    allocate_candidates,
    find_candidates,
    write_candidate_blocks,
)
from octasplat.engine.trace.cpu.kernels.packet_hits import BLOCKS_PER_CHUNK, eval_alphas, intersect_blocks
from octasplat.engine.trace.cpu.kernels.packet_sort import copy_candidates_unsorted
from octasplat.engine.trace.cpu.kernels.packet_traversal import allocate_frustum, allocate_traversal
from octasplat.engine.trace.cpu.kernels.rays import next_packet, ray_limits, ray_origin, ray_slopes
from octasplat.engine.trace.kernels.native import njit_no_refcount


@njit_no_refcount(fastmath={"contract"})
def ray_transmittance(
    r: int,
    ray_bit: int,
    rays: RayArrays,
    frame: Float64[np.ndarray, "15"],
    candidates: Candidates,
    count: int,
    limits: TraceLimits,
) -> float:
    """Return what candidates leave of ray ``r``, ray ``ray_bit`` of its packet; 0 where it is below eps1."""
    slopes, span = ray_slopes(rays, r, frame), ray_limits(rays, r)
    block_count = (count + WIDTH - 1) // WIDTH
    transmittance = 1.0
    for b0 in range(0, block_count, BLOCKS_PER_CHUNK):
        # hits in any order: a product of 1 - alpha does not depend on it
        tail = intersect_blocks(candidates, ray_bit, b0, slopes, span, 0)
        eval_alphas(candidates, 0, tail, limits.alpha_max)
        for m in range(tail):
            transmittance *= 1.0 - candidates.alphas[m]
            if transmittance < limits.eps1:
                return 0.0
    return transmittance


@kernel(error_model="numpy")
def packet_transmittance(
    rays: RayArrays,
    scene: PackedScene,
    limits: TraceLimits,
    packets: Int64[np.ndarray, "p 2"],
    bvh: BvhArrays,
    counter: Int64[np.ndarray, "1"],
    transmittance: Float32[np.ndarray, " r"],
) -> None:
    """Write the transmittance of the rays of packets until the ``counter`` has passed the last packet."""
    pyramid, walk = allocate_frustum(), allocate_traversal()
    candidates = allocate_candidates(INITIAL_CAPACITY)
    while True:
        packet, first, last = next_packet(counter, packets)
        if packet < 0:
            break
        candidates, count = find_candidates(rays, first, last, bvh, pyramid, walk, candidates)
        copy_candidates_unsorted(candidates, count, bvh.order)
        write_candidate_blocks(candidates, count, scene, ray_origin(rays, first), pyramid.frame, False)
        for r in range(first, last):
            transmittance[r] = ray_transmittance(r, r - first, rays, pyramid.frame, candidates, count, limits)
