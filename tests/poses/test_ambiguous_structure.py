"""Folds of a model: two sides held together by false matches, and the true ones broken."""

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
