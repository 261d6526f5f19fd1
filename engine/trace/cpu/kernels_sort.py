"""A stable parallel sort of hits by Gaussian, so that gradients are summed in one fixed order."""

import numpy as np
from numba import njit, prange

DIGIT_BITS = 11
BUCKETS = 1 << DIGIT_BITS


@njit(cache=True, parallel=True)
def _sort_pass(keys, order, shift, keys_out, order_out, histograms):
    chunks = histograms.shape[0]
    count = len(keys)
    per = (count + chunks - 1) // chunks
    for c in prange(chunks):
        histograms[c, :] = 0
        for e in range(c * per, min(count, (c + 1) * per)):
            histograms[c, (keys[e] >> shift) & (BUCKETS - 1)] += 1
    total = 0
    for b in range(BUCKETS):
        for c in range(chunks):
            size = histograms[c, b]
            histograms[c, b] = total
            total += size
    for c in prange(chunks):
        for e in range(c * per, min(count, (c + 1) * per)):
            bucket = (keys[e] >> shift) & (BUCKETS - 1)
            slot = histograms[c, bucket]
            histograms[c, bucket] = slot + 1
            keys_out[slot] = keys[e]
            order_out[slot] = order[e]


@njit(cache=True)
def _segment_starts(keys, starts):
    segments = 0
    for e in range(len(keys)):
        if e == 0 or keys[e] != keys[e - 1]:
            starts[segments] = e
            segments += 1
    starts[segments] = len(keys)
    return segments


def sort_by_gaussian(
    keys: np.ndarray, gaussian_count: int, threads: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stable order of ``keys`` and where each key begins.

    The result does not depend on ``threads``. Returns (order, sorted keys, starts) with one more start
    than there are distinct keys.
    """
    order = np.arange(len(keys), dtype=np.int32)
    histograms = np.empty((max(1, threads), BUCKETS), np.int64)
    keys_out, order_out = np.empty_like(keys), np.empty_like(order)
    shift = 0
    while shift == 0 or gaussian_count - 1 >> shift > 0:
        _sort_pass(keys, order, shift, keys_out, order_out, histograms)
        keys, keys_out, order, order_out = keys_out, keys if shift else np.empty_like(keys), order_out, order
        shift += DIGIT_BITS
    starts = np.empty(len(keys) + 1, np.int64)
    segments = _segment_starts(keys, starts)
    return order, keys, starts[: segments + 1]
