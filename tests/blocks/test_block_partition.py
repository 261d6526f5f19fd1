"""Cuts into boxes: they cover space, do not overlap, and hold about equal weights."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from octasplat.engine.blocks.partition import cut_into_boxes, weighted_spread
from octasplat.engine.core.errors import ConfigError


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 1000), st.integers(1, 9), st.integers(20, 200))
def test_boxes_cover_space_without_overlap(seed: int, count: int, points: int) -> None:
    rng = np.random.default_rng(seed)
    xyz = rng.normal(size=(points, 3)) * [3, 1, 2]
    boxes = cut_into_boxes(xyz, rng.uniform(0.5, 1.5, points), count)
    assert len(boxes) == count
    anywhere = np.concatenate([xyz, 100 * rng.normal(size=(500, 3))])
    holders = sum(box.contains(anywhere).astype(int) for box in boxes)
    assert (holders == 1).all()


def test_weights_are_shared_out_equally() -> None:
    rng = np.random.default_rng(3)
    xyz, weights = rng.uniform(size=(4000, 3)), rng.uniform(size=4000)
    for count in (2, 3, 5, 8):
        boxes = cut_into_boxes(xyz, weights, count)
        shares = [weights[box.contains(xyz)].sum() / weights.sum() for box in boxes]
        np.testing.assert_allclose(shares, 1 / count, rtol=0.02)


def test_cut_is_between_two_clusters_along_the_longest_axis() -> None:
    xyz = np.array([[0, y, 0.1 * y] for y in (0.0, 1.0, 2.0, 7.0, 8.0, 9.0)])
    below, above = cut_into_boxes(xyz, np.ones(6), 2)
    assert below.high_world.tolist() == [np.inf, 4.5, np.inf]
    assert above.low_world.tolist() == [-np.inf, 4.5, -np.inf]


def test_points_of_no_weight_count_for_nothing() -> None:
    xyz = np.array([[0.0, 0, 0], [1, 0, 0], [500, 0, 0], [900, 0, 0]])
    below, _ = cut_into_boxes(xyz, np.array([1.0, 1, 0, 0]), 2)
    assert below.high_world[0] == 0.5


def test_a_single_place_cannot_be_cut() -> None:
    with pytest.raises(ConfigError, match="fewer blocks"):
        cut_into_boxes(np.ones((10, 3)), np.ones(10), 2)


def test_spread_leaves_out_the_last_shares() -> None:
    xyz = np.zeros((1001, 3))
    xyz[:, 0] = np.arange(1001)
    xyz[-1, 1] = 1e6
    np.testing.assert_allclose(weighted_spread(xyz, np.ones(1001)), [900, 0, 0], atol=2)
