"""A stable parallel sort by integer keys.

Hits are sorted by Gaussian, so that gradients are summed in one fixed order, and Gaussians along the Z-order
curve of the packets' hierarchy.
"""

import numpy as np
from jaxtyping import Int, Int32, Int64, Shaped

from octasplat.engine.core.compilation import kernel, run_ranges

DIGIT_BITS = 11
BUCKETS = 1 << DIGIT_BITS
MIN_CHUNK_KEYS = 4096
"""Keys that are worth a thread: fewer are sorted faster than their histogram is added up."""
SEGMENT_CHUNKS = 64
"""Parts in which the first of equal keys are looked for."""


@kernel(_nrt=False)
def _count_digits(
    first: int,
    last: int,
    keys: Int[np.ndarray, " e"],
    shift: int,
    histograms: Int64[np.ndarray, "chunks buckets"],
) -> None:
    """Write the histogram of a digit for each of the chunks ``first`` to ``last``."""
    count = len(keys)
    per = (count + len(histograms) - 1) // len(histograms)
    for c in range(first, last):
        histograms[c, :] = 0
        for e in range(c * per, min(count, (c + 1) * per)):
            histograms[c, np.int64(keys[e] >> shift) & (BUCKETS - 1)] += 1


@kernel(_nrt=False)
def _add_up(histograms: Int64[np.ndarray, "chunks buckets"]) -> None:
    """Replace each count by the place of its first key."""
    total = 0
    # For each bucket chunk by chunk: equal keys keep their order, so that the sort is stable.
    for b in range(BUCKETS):
        for c in range(len(histograms)):
            size = histograms[c, b]
            histograms[c, b] = total
            total += size


@kernel(_nrt=False)
def _scatter(
    first: int,
    last: int,
    keys: Int[np.ndarray, " e"],
    order: Int32[np.ndarray, " e"],
    shift: int,
    keys_out: Int[np.ndarray, " e"],
    order_out: Int32[np.ndarray, " e"],
    histograms: Int64[np.ndarray, "chunks buckets"],
) -> None:
    """Move the keys of the chunks ``first`` to ``last`` to their places."""
    count = len(keys)
    per = (count + len(histograms) - 1) // len(histograms)
    for c in range(first, last):
        for e in range(c * per, min(count, (c + 1) * per)):
            bucket = np.int64(keys[e] >> shift) & (BUCKETS - 1)
            slot = histograms[c, bucket]
            # each chunk has places of its own: threads never write to the same one
            histograms[c, bucket] = slot + 1
            keys_out[slot] = keys[e]
            order_out[slot] = order[e]


@kernel(_nrt=False)
def _count_segments(
    first: int, last: int, keys: Int32[np.ndarray, " e"], firsts: Int64[np.ndarray, " chunks"]
) -> None:
    """Write how many segments begin in each of the chunks ``first`` to ``last``."""
    count, chunks = len(keys), len(firsts)
    for c in range(first, last):
        found = 0
        for e in range(c * count // chunks, (c + 1) * count // chunks):
            if e == 0 or keys[e] != keys[e - 1]:
                found += 1
        firsts[c] = found


@kernel(_nrt=False)
def _write_segments(
    first: int,
    last: int,
    keys: Int32[np.ndarray, " e"],
    starts: Int64[np.ndarray, " s1"],
    firsts: Int64[np.ndarray, " chunks"],
) -> None:
    """Write where the segments of the chunks ``first`` to ``last`` begin; ``firsts`` are their numbers."""
    count, chunks = len(keys), len(firsts)
    for c in range(first, last):
        segment = firsts[c]
        for e in range(c * count // chunks, (c + 1) * count // chunks):
            if e == 0 or keys[e] != keys[e - 1]:
                starts[segment] = e
                segment += 1


def stable_argsort(
    keys: Shaped[np.ndarray, " e"], bits: int, threads: int
) -> tuple[Int32[np.ndarray, " e"], Shaped[np.ndarray, " e"]]:
    """Return the order that sorts ``keys``, in which equal ones stay as they are, and the sorted keys.

    The result does not depend on ``threads``.

    Args:
        keys: integers from 0 on; left as they are.
        bits: that the largest one has.
        threads: how many to take at most.
    """
    order = np.arange(len(keys), dtype=np.int32)
    chunks = max(1, min(threads, len(keys) // MIN_CHUNK_KEYS))
    histograms = np.empty((chunks, BUCKETS), np.int64)
    source, target, spare, order_out = keys, np.empty_like(keys), np.empty_like(keys), np.empty_like(order)
    for shift in np.arange(0, max(1, bits), DIGIT_BITS, dtype=keys.dtype):
        run_ranges(_count_digits, threads, chunks, source, shift, histograms, grain=1)
        _add_up(histograms)
        run_ranges(_scatter, threads, chunks, source, order, shift, target, order_out, histograms, grain=1)
        order, order_out = order_out, order
        source, target = target, spare if source is keys else source  # the caller's keys are never written to
    return order, source


def sort_by_gaussian(
    keys: Int[np.ndarray, " e"], gaussian_count: int, threads: int
) -> tuple[Int32[np.ndarray, " e"], Int[np.ndarray, " e"], Int64[np.ndarray, " s1"]]:
    """Return the stable order of ``keys`` and the first position of each key.

    The result does not depend on ``threads``. Returns (order, sorted keys, starts) with one more start
    than there are distinct keys.
    """
    order, keys = stable_argsort(keys, (gaussian_count - 1).bit_length(), threads)
    starts = np.empty(len(keys) + 1, np.int64)
    counts = np.empty(SEGMENT_CHUNKS, np.int64)
    run_ranges(_count_segments, threads, SEGMENT_CHUNKS, keys, counts, grain=1)
    ends = np.cumsum(counts)
    run_ranges(_write_segments, threads, SEGMENT_CHUNKS, keys, starts, ends - counts, grain=1)
    segments = int(ends[-1])
    starts[segments] = len(keys)
    return order, keys, starts[: segments + 1]
