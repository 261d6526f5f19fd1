"""The order in which a packet's candidates are tested."""

import numpy as np

from octasplat.engine.trace.cpu.kernels_footprint import CELLS
from octasplat.engine.trace.cpu.kernels_packet import CHUNK, WORD
from octasplat.engine.trace.cpu.kernels_tree import WIDTH
from octasplat.engine.trace.kernels_native import lean

FEW_KEYS = 48
"""An insertion sort is faster than two passes over 256 buckets for so few."""


@lean(fastmath={"contract"})
def sort_candidates(candidates, count, order, histogram):
    """Order the candidates in chunks by distance, within a chunk by the rays that may meet them."""
    keys, bounds, cells, near = candidates.keys, candidates.bounds, candidates.cells, candidates.near
    block_rays = candidates.block_rays
    sort_by_distance(candidates, count, histogram)
    nearest = np.float32(np.inf)
    near[count] = nearest
    for k in range(count - 1, -1, -1):
        nearest = min(nearest, bounds[np.int64(keys[k] & np.uint64(0xFFFFFFFF))])
        near[k] = nearest
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
            candidates.ids[place] = order[candidates.found[which]]
            block_rays[place // WIDTH] |= candidates.masks[which]
    turn_bits(candidates, count)


@lean(forceinline=True)
def sort_by_distance(candidates, count, histogram):
    """Sort the keys of the candidates."""
    if count > FEW_KEYS:
        sort_keys(candidates.keys, candidates.pending, count, histogram)
    else:
        insertion_sort(candidates.keys, count)


@lean()
def keep_candidates(candidates, count, order):
    """Leave the candidates in the order in which they were found, where none is needed."""
    for b in range((count + WIDTH - 1) // WIDTH):
        candidates.block_rays[b] = 0
    for k in range(count):
        candidates.ids[k] = order[candidates.found[k]]
        candidates.block_rays[k // WIDTH] |= candidates.masks[k]
    turn_bits(candidates, count)


@lean()
def turn_bits(candidates, count):
    """The blocks of each ray from the rays of each block: squares of 64 bits are turned over.

    Halves of a square change places, then quarters within the halves, down to single bits.
    """
    blocks = (count + WIDTH - 1) // WIDTH
    for w in range((blocks + WORD - 1) // WORD):
        bits = candidates.ray_blocks[w]
        for k in range(WORD):
            block = w * WORD + k
            bits[k] = candidates.block_rays[block] if block < blocks else np.uint64(0)
        step, mask = np.uint64(32), np.uint64(0xFFFFFFFF)
        while step > 0:
            for half in range(0, WORD, 2 * step):
                for k in range(half, half + np.int64(step)):
                    other = k + np.int64(step)
                    change = ((bits[k] >> step) ^ bits[other]) & mask
                    bits[k] ^= change << step
                    bits[other] ^= change
            step >>= np.uint64(1)
            mask ^= mask << step


@lean()
def insertion_sort(keys, count):
    """Sort a few keys in place."""
    for i in range(1, count):
        key = keys[i]
        j = i
        while j > 0 and keys[j - 1] > key:
            keys[j] = keys[j - 1]
            j -= 1
        keys[j] = key


@lean()
def sort_keys(keys, scratch, count, histogram):
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
    while span >= np.uint64(1 << 16):
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
        keys, scratch = scratch, keys
    insertion_sort(keys, count)
