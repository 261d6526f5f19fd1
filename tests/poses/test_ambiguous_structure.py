"""Folds of a model: two sides held together by false matches, and the true ones broken."""

import tracemalloc

import numpy as np
import pytest

from octasplat.engine.poses.ambiguous_structure import PairInliers, find_false_pairs


def votes(rows: list[tuple[int, int, int, int]]) -> PairInliers:
    table = np.array(rows, dtype=np.int64).reshape(-1, 4)
    return PairInliers(table[:, :2], table[:, 2], table[:, 3])


def loop(start: int, count: int) -> list[tuple[int, int, int, int]]:
    """Neighbours whose matches are kept, but for a few."""
    return [(start + k, start + k + 1, 200, 5) for k in range(count - 1)]


def test_unambiguous_model_has_no_folds() -> None:
    assert len(find_false_pairs(votes([*loop(1, 8), (1, 8, 150, 10), (2, 6, 0, 60)]))) == 0
    assert len(find_false_pairs(votes([]))) == 0


@pytest.mark.parametrize("second", [8, 3, 1])
def test_ambiguous_pairs_are_found(second: int) -> None:
    rows = [*loop(1, 10), *loop(11, second)]
    false = [(4, 11, 90, 3), (5, 11, 80, 0)]
    true = [(number, 11, 1, 150) for number in (8, 9, 10)]
    found = find_false_pairs(votes([*rows, *false, *true]))
    assert found.tolist() == [[4, 11], [5, 11]]


def test_fold_of_thousands_of_photographs_takes_little_memory() -> None:
    count, half = 5000, 2500
    rng = np.random.default_rng(0)
    near = [(k, k + d, 200, 5) for d in range(1, 9) for k in range(1, count + 1 - d)]
    rows = [row for row in near if (row[0] <= half) == (row[1] <= half)]
    false = [(100, half + 1, 90, 3), (101, half + 1, 80, 0), (102, half + 2, 60, 10)]
    true = {(int(a), int(a) + half) for a in rng.integers(1, half + 1, 300)}
    # pairs of one side that match falsely, as everywhere
    stray = [(int(a), int(a) + 40, 1, 30) for a in rng.choice(half - 50, 100, replace=False) + 1]
    table = votes([*rows, *false, *((a, b, 1, 150) for a, b in sorted(true)), *stray])
    tracemalloc.start()
    found = find_false_pairs(table)
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.tolist() == [list(pair[:2]) for pair in false]
    assert peak_bytes < 64 << 20  # the matrix of all pairs alone would take 200 MB
