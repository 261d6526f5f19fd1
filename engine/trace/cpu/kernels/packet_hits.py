"""What one ray of a packet meets: candidates tested eight at once, their alphas, and the order of hits."""

import numpy as np
from jaxtyping import UInt64

from octasplat.engine.trace.cpu.kernels.kernel_args import Candidates
from octasplat.engine.trace.cpu.kernels.packet_bvh import WIDTH
from octasplat.engine.trace.cpu.kernels.packet_candidates import CANDIDATE_BLOCK_BYTES, CHUNK, MASK_BITS
from octasplat.engine.trace.cpu.kernels.simd8 import (
    HitBuffer,
    PacketRay,
    eval_alphas8,
    intersect_block8,
    rank_sort,
)
from octasplat.engine.trace.cpu.kernels.simd_vector import lowest_bit
from octasplat.engine.trace.kernels.native import njit_no_refcount

RANK_SORT_MAX = 96
"""Hits that are sorted by counting, for each, the smaller ones, eight at once: quadratic, but without a
branch that the processor could guess wrongly. The few longer lists take an insertion sort.
"""
BLOCKS_PER_CHUNK = CHUNK // WIDTH
CHUNK_BLOCKS_MASK = np.uint64((1 << BLOCKS_PER_CHUNK) - 1)
LOW_WORD_MASK = np.uint64(0xFFFFFFFF)
HIGH_WORD_SHIFT = np.uint64(32)


@njit_no_refcount()
def sort_ties_by_id(candidates: Candidates, first: int, last: int) -> None:
    """Order the hits ``first`` to ``last``, which are sorted by distance, by id where distances are equal."""
    pending, numbers, ids = candidates.hit_keys, candidates.hit_candidates, candidates.ids
    for i in range(first + 1, last):
        key = pending[i]
        if key >> HIGH_WORD_SHIFT != pending[i - 1] >> HIGH_WORD_SHIFT:
            continue
        mine = ids[numbers[np.int64(key & LOW_WORD_MASK)]]
        j = i
        while (
            j > first
            and pending[j - 1] >> HIGH_WORD_SHIFT == key >> HIGH_WORD_SHIFT
            and ids[numbers[np.int64(pending[j - 1] & LOW_WORD_MASK)]] > mine
        ):
            pending[j] = pending[j - 1]
            j -= 1
        pending[j] = key


@njit_no_refcount()
def sort_hits(candidates: Candidates, rank_buffer: UInt64[np.ndarray, "104"], first: int, last: int) -> None:
    """Sort the hits ``first`` to ``last`` of a ray by distance, and by id where they share one."""
    # stable by construction: places in the lower halves make all keys different
    if last - first <= RANK_SORT_MAX:
        if rank_sort(candidates.hit_keys.ctypes.data + first * 8, last - first, rank_buffer.ctypes.data):
            sort_ties_by_id(candidates, first, last)
        return
    pending = candidates.hit_keys
    for i in range(first + 1, last):
        key = pending[i]
        j = i
        while j > first and pending[j - 1] > key:
            pending[j] = pending[j - 1]
            j -= 1
        pending[j] = key
    sort_ties_by_id(candidates, first, last)


@njit_no_refcount(forceinline=True)
def intersect_blocks(
    candidates: Candidates,
    ray_bit: int,
    first: int,
    slopes: tuple[float, float, float],
    limits: tuple[float, float],
    hit_count: int,
) -> int:
    """Test the ``BLOCKS_PER_CHUNK`` blocks from ``first`` on that the packet's ray ``ray_bit`` may meet.

    Returns how many hits there are then; ``hit_count`` are known already. The blocks' bits lie in one word.
    """
    ray = PacketRay(
        np.float32(slopes[0]), np.float32(slopes[1]), np.float32(slopes[2]),
        np.float32(limits[0]), np.float32(limits[1]),
    )  # fmt: skip
    c = candidates
    hits = HitBuffer(
        c.hit_keys.ctypes.data, c.alphas.ctypes.data, c.opacities.ctypes.data, c.us.ctypes.data,
        c.vs.ctypes.data, c.hit_candidates.ctypes.data,
    )  # fmt: skip
    blocks_at = c.blocks.ctypes.data
    # a chunk begins at a multiple of its size, so that its bits are in one word
    bits = (
        c.ray_block_masks[first // MASK_BITS, ray_bit] >> np.uint64(first % MASK_BITS)
    ) & CHUNK_BLOCKS_MASK
    bits = np.int64(bits)
    while bits != 0:
        block = first + lowest_bit(bits)
        bits &= bits - 1
        hit_count += intersect_block8(
            blocks_at + block * CANDIDATE_BLOCK_BYTES, ray, block * WIDTH, hit_count, hits
        )
    return hit_count


@njit_no_refcount(forceinline=True)
def eval_alphas(candidates: Candidates, first: int, last: int, alpha_max: float) -> None:
    """Write alphas of the hits ``first`` to ``last`` of a ray."""
    for place in range(first, last, WIDTH):
        eval_alphas8(
            candidates.alphas.ctypes.data, candidates.opacities.ctypes.data, place, np.float32(alpha_max)
        )
