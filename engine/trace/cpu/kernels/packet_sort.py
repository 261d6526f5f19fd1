"""Sort of a packet's candidates into the order in which they are tested."""

import numpy as np
from jaxtyping import Int32, UInt64

from octasplat.engine.trace.cpu.kernels.kernel_args import Candidates
from octasplat.engine.trace.cpu.kernels.packet_bvh import WIDTH
from octasplat.engine.trace.cpu.kernels.packet_candidates import CHUNK, MASK_BITS
from octasplat.engine.trace.cpu.kernels.ray_mask import CELLS
from octasplat.engine.trace.kernels.native import njit_no_refcount

INSERTION_SORT_MAX = 48
"""An insertion sort is faster than two passes over 256 buckets for so few."""


@njit_no_refcount(fastmath={"contract"})
def sort_candidates(
    candidates: Candidates, count: int, order: Int32[np.ndarray, " n"], histogram: Int32[np.ndarray, "256"]
) -> None:
    """Order the candidates in chunks by distance, within a chunk by the rays that may meet them."""
    keys, bounds, cells, near = (
        candidates.keys,
        candidates.min_distances,
        candidates.cells,
        candidates.min_distance_after,
    )
    block_rays = candidates.block_ray_masks
    sort_by_distance(candidates, count, histogram)
    # --- suffix minima: no candidate from k on has a hit before near[k] ---
    nearest = np.float32(np.inf)
    near[count] = nearest
    for k in range(count - 1, -1, -1):
        nearest = min(nearest, bounds[np.int64(keys[k] & np.uint64(0xFFFFFFFF))])
        near[k] = nearest
    # --- within each chunk a counting sort by cell: neighbours in the cross section share their rays ---
    for b in range((count + WIDTH - 1) // WIDTH):
        block_rays[b] = 0
    for start in range(0, count, CHUNK):
        end = min(start + CHUNK, count)
        histogram[: CELLS + 1] = 0
        for k in range(start, end):
            histogram[cells[np.int64(keys[k] & np.uint64(0xFFFFFFFF))] + 1] += 1
        for cell in range(CELLS):
            histogram[cell + 1] += histogram[cell]
        for k in range(start, end):
            which = np.int64(keys[k] & np.uint64(0xFFFFFFFF))
            cell = cells[which]
            place = start + histogram[cell]
            histogram[cell] += 1
            candidates.ids[place] = order[candidates.curve_indices[which]]
            block_rays[place // WIDTH] |= candidates.ray_masks[which]
    transpose_ray_masks(candidates, count)


@njit_no_refcount(forceinline=True)
def sort_by_distance(candidates: Candidates, count: int, histogram: Int32[np.ndarray, "256"]) -> None:
    """Sort the keys of the candidates."""
    if count > INSERTION_SORT_MAX:
        radix_sort_keys(candidates.keys, candidates.hit_keys, count, histogram)
    else:
        insertion_sort(candidates.keys, count)


@njit_no_refcount()
def copy_candidates_unsorted(candidates: Candidates, count: int, order: Int32[np.ndarray, " n"]) -> None:
    """Copy the candidates in the order in which they were found, where no order is needed."""
    for b in range((count + WIDTH - 1) // WIDTH):
        candidates.block_ray_masks[b] = 0
    for k in range(count):
        candidates.ids[k] = order[candidates.curve_indices[k]]
        candidates.block_ray_masks[k // WIDTH] |= candidates.ray_masks[k]
    transpose_ray_masks(candidates, count)


@njit_no_refcount()
def transpose_ray_masks(candidates: Candidates, count: int) -> None:
    """Write the blocks of each ray from the rays of each block: squares of 64 bits are turned over.

    Halves of a square change places, then quarters within the halves, down to single bits.
    """
    blocks = (count + WIDTH - 1) // WIDTH
    for w in range((blocks + MASK_BITS - 1) // MASK_BITS):
        bits = candidates.ray_block_masks[w]
        for k in range(MASK_BITS):
            block = w * MASK_BITS + k
            bits[k] = candidates.block_ray_masks[block] if block < blocks else np.uint64(0)
        step, mask = np.uint64(32), np.uint64(0xFFFFFFFF)
        while step > 0:
            for half in range(0, MASK_BITS, 2 * step):
                for k in range(half, half + np.int64(step)):
                    other = k + np.int64(step)
                    change = ((bits[k] >> step) ^ bits[other]) & mask
                    bits[k] ^= change << step
                    bits[other] ^= change
            step >>= np.uint64(1)
            mask ^= mask << step  # 32 ones, then 16 ones and 16 zeros in turn, down to single bits


@njit_no_refcount()
def insertion_sort(keys: UInt64[np.ndarray, " c"], count: int) -> None:
    """Sort a few keys in place."""
    for i in range(1, count):
        key = keys[i]
        j = i
        while j > 0 and keys[j - 1] > key:
            keys[j] = keys[j - 1]
            j -= 1
        keys[j] = key


@njit_no_refcount()
def radix_sort_keys(
    keys: UInt64[np.ndarray, " c"],
    scratch: UInt64[np.ndarray, " c"],
    count: int,
    histogram: Int32[np.ndarray, "256"],
) -> None:
    """Sort in place by the upper bits of the keys' distances, then by the rest.

    Two passes over the 16 bits below the distances' common upper bits leave so little disorder that the
    insertion sort afterwards hardly moves anything.
    """
    low, high = keys[0], keys[0]
    for k in range(1, count):
        low, high = min(low, keys[k]), max(high, keys[k])
    low, high = low >> np.uint64(32), high >> np.uint64(32)
    shift = np.uint64(32)
    span = high - low
    while span >= np.uint64(1 << 16):  # until the span of the distances fits two digits of eight bits
        span >>= np.uint64(1)
        shift += np.uint64(1)
    low <<= np.uint64(32)
    for digit in range(2):
        histogram[:] = 0
        at = shift + np.uint64(8 * digit)
        for k in range(count):
            histogram[((keys[k] - low) >> at) & np.uint64(255)] += 1
        total = 0
        for b in range(256):
            size = histogram[b]
            histogram[b] = total
            total += size
        for k in range(count):
            bucket = ((keys[k] - low) >> at) & np.uint64(255)
            scratch[histogram[bucket]] = keys[k]
            histogram[bucket] += 1
        keys, scratch = scratch, keys  # swapped twice: the sorted keys end in the caller's array
    insertion_sort(keys, count)
