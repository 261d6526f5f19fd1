"""One order for many viewers, where the right one is known."""

import numpy as np
import pytest

from octasplat.engine.render.depth_order import shared_depth_order


def test_points_on_a_line_are_ordered_from_far_to_near():
    points = np.array([[0, 0, 2.0], [0, 0, 5.0], [0, 0, 3.0]])
    order, agreement = shared_depth_order(points, np.array([[0, 0, 0.0], [0.1, 0, 0]]))
    assert order.tolist() == [1, 2, 0]
    assert agreement == pytest.approx(1.0)


def test_draw_order_follows_majority():
    points = np.array([[0, 0, z] for z in (1.0, 2.0, 3.0, 4.0)])
    front, back = [0, 0, 0.0], [0, 0, 10.0]
    order, _ = shared_depth_order(points, np.array([front, front, back]))
    assert order.tolist() == [3, 2, 1, 0]
    ball = np.random.default_rng(0).standard_normal((500, 3))
    # as far as each other: their ranks are the same, and their order stays
    ring = np.array([[1.0, 0, 0], [0, 0, 3], [0, 1, 0], [-1, 0, 0]])
    order, agreement = shared_depth_order(ring, np.zeros((1, 3)))
    assert order.tolist() == [1, 0, 2, 3] and agreement == pytest.approx(1.0)
    around = 9 * ball[:40] / np.linalg.norm(ball[:40], axis=1, keepdims=True)
    assert abs(shared_depth_order(ball, around)[1]) < 0.3


def test_draw_order_of_empty_scene_is_empty():
    order, agreement = shared_depth_order(np.zeros((0, 3)), np.zeros((2, 3)))
    assert len(order) == 0 and agreement == 1.0
