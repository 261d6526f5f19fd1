"""Selection of the pairs of photographs to match."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float32, Int64

Pair = tuple[int, int]
_TILE = 8


def pair_count(count: int) -> int:
    """Return the number of pairs of ``count`` photographs."""
    return count * (count - 1) // 2


def neighbor_pairs(count: int, neighbours: int) -> set[Pair]:
    """Return each photograph with those that follow it by name, the lower index first."""
    return {(a, b) for a in range(count) for b in range(a + 1, min(a + 1 + neighbours, count))}


def all_pairs(count: int) -> list[Pair]:
    """Return every pair of ``count`` photographs, the lower index first."""
    return list(combinations(range(count), 2))


def select_pairs(
    match_counts: Mapping[Pair, int], count: int, *, min_matches: int, partners: int, neighbours: int
) -> list[Pair]:
    """Return pairs that have matches in common, and neighbours by name.

    The quick look is the preemptive matching of Wu, "Towards Linear-time Incremental Structure from Motion"
    (3DV 2013): two photographs that share features share some of the largest ones.

    Args:
        match_counts: matches of the largest features, of pairs that have any.
        count: photographs in all.
        min_matches: matches that make a pair worth it.
        partners: most pairs of one photograph, the best ones; another's choice may add to them.
        neighbours: in the order of names, on either side, in any case.
    """
    kept = neighbor_pairs(count, neighbours)
    of: list[list[tuple[int, Pair]]] = [[] for _ in range(count)]
    for pair, matches in match_counts.items():
        if matches >= min_matches:
            for end in pair:
                of[end].append((-matches, pair))
    for found in of:
        kept |= {pair for _, pair in sorted(found)[:partners]}
    return sorted(kept)


def batch_pairs(pairs: Iterable[Pair], size: int) -> list[tuple[Pair, ...]]:
    """Yield pairs in batches, those of the same photographs together, as COLMAP loads each only once then."""
    # tiles of pairs, in which COLMAP's cache finds its photographs again
    ordered = sorted(pairs, key=lambda pair: (pair[0] // _TILE, pair[1] // _TILE, pair))
    return [tuple(ordered[start : start + size]) for start in range(0, len(ordered), size)]


def largest_features(keypoints: Float32[np.ndarray, "n 6"], count: int) -> Int64[np.ndarray, " k"]:
    """Return the sorted indices of the ``count`` features of largest scale; columns as in COLMAP."""
    # determinant of the affine shape
    area = np.abs(keypoints[:, 2] * keypoints[:, 5] - keypoints[:, 3] * keypoints[:, 4])
    kept: Int64[np.ndarray, " k"] = np.sort(np.argsort(-area, kind="stable")[:count])
    return kept


def pairs_with(
    photographs: Sequence[int], count: int, excluded: Iterable[Pair], *, within: int | None = None
) -> list[Pair]:
    """Return pairs of ``photographs`` with any other, except those in ``excluded``.

    Args:
        photographs: some of them.
        count: photographs in all.
        excluded: pairs to leave out.
        within: only those so near by name; None for all.
    """
    reach = count if within is None else within
    wanted = {
        (min(a, b), max(a, b))
        for a in photographs
        for b in range(max(0, a - reach), min(count, a + reach + 1))
        if a != b
    }
    return sorted(wanted - set(excluded))
