"""A stable parallel sort by integer keys.

Hits are sorted by Gaussian, so that gradients are summed in one fixed order, and Gaussians along the curve of
the packets' hierarchy.
"""

import numpy as np
from jaxtyping import Int, Int32, Int64, Shaped
from numba import njit, prange

DIGIT_BITS = 11
BUCKETS = 1 << DIGIT_BITS
LEAST_CHUNK = 4096
"""Keys that are worth a thread: fewer are sorted faster than their histogram is added up."""
START_CHUNKS = 64
"""Parts in which the first of equal keys are looked for."""


@njit(cache=True, parallel=True)
def _sort_pass(keys, order, shift, keys_out, order_out, histograms):
    chunks = histograms.shape[0]
    count = len(keys)
    per = (count + chunks - 1) // chunks
    for c in prange(chunks):
        histograms[c, :] = 0
        for e in range(c * per, min(count, (c + 1) * per)):
            histograms[c, np.int64(keys[e] >> shift) & (BUCKETS - 1)] += 1
    total = 0
    for b in range(BUCKETS):
        for c in range(chunks):
            size = histograms[c, b]
            histograms[c, b] = total
            total += size
    for c in prange(chunks):
        for e in range(c * per, min(count, (c + 1) * per)):
            bucket = np.int64(keys[e] >> shift) & (BUCKETS - 1)
            slot = histograms[c, bucket]
            histograms[c, bucket] = slot + 1
            keys_out[slot] = keys[e]
            order_out[slot] = order[e]


@njit(cache=True)
def _sort(keys, order, keys_out, order_out, spare, shifts, histograms):
    """All passes; ``keys`` are left as they are, ``spare`` is room for as many."""
    _sort_pass(keys, order, shifts[0], keys_out, order_out, histograms)
    source, target = keys_out, spare
    for k in range(1, len(shifts)):
        order, order_out = order_out, order
        _sort_pass(source, order, shifts[k], target, order_out, histograms)
        source, target = target, source
    return order_out, source


@njit(cache=True, parallel=True)
def _segment_starts(keys, starts, firsts):
    count, chunks = len(keys), len(firsts)
    for c in prange(chunks):
        found = 0
        for e in range(c * count // chunks, (c + 1) * count // chunks):
            if e == 0 or keys[e] != keys[e - 1]:
                found += 1
        firsts[c] = found
    segments = 0
    for c in range(chunks):
        found = firsts[c]
        firsts[c] = segments
        segments += found
    for c in prange(chunks):
        segment = firsts[c]
        for e in range(c * count // chunks, (c + 1) * count // chunks):
            if e == 0 or keys[e] != keys[e - 1]:
                starts[segment] = e
                segment += 1
    starts[segments] = count
    return segments


def stable_order(
    keys: Shaped[np.ndarray, " e"], bits: int, threads: int
) -> tuple[Int32[np.ndarray, " e"], Shaped[np.ndarray, " e"]]:
    """The order that sorts ``keys``, in which equal ones stay as they are, and the sorted keys.

    The result does not depend on ``threads``.

    Args:
        keys: integers from 0 on; left as they are.
        bits: that the largest one has.
        threads: how many to take at most.
    """
    order = np.arange(len(keys), dtype=np.int32)
    histograms = np.empty((max(1, min(threads, len(keys) // LEAST_CHUNK)), BUCKETS), np.int64)
    shifts = np.arange(0, max(1, bits), DIGIT_BITS, dtype=keys.dtype)
    room = np.empty_like(keys), np.empty_like(order), np.empty_like(keys)
    return _sort(keys, order, *room, shifts, histograms)


def sort_by_gaussian(
    keys: Int[np.ndarray, " e"], gaussian_count: int, threads: int
) -> tuple[Int32[np.ndarray, " e"], Int[np.ndarray, " e"], Int64[np.ndarray, " s1"]]:
    """Stable order of ``keys`` and where each key begins.

    The result does not depend on ``threads``. Returns (order, sorted keys, starts) with one more start
    than there are distinct keys.
    """
    order, keys = stable_order(keys, (gaussian_count - 1).bit_length(), threads)
    starts = np.empty(len(keys) + 1, np.int64)
    segments = _segment_starts(keys, starts, np.empty(START_CHUNKS, np.int64))
    return order, keys, starts[: segments + 1]
