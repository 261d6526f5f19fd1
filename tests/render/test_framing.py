"""The visible part of a scene."""

import numpy as np
import pytest

from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.framing import visible_bounds

UP = np.array([0.0, -1.0, 0.0])


@pytest.mark.parametrize("count", [1, 2, 7, 500, 5000])
@pytest.mark.parametrize("is_even", [True, False])
def test_bounds_leave_out_a_five_hundredth_at_either_end(count: int, is_even: bool) -> None:
    rng = np.random.default_rng(count)
    logits = np.full(count, 20.0) if is_even else rng.normal(size=count)
    gaussians = FlatGaussians(
        rng.uniform(-1, 1, (count, 3)).astype(np.float32),
        np.tile(np.eye(1, 4, dtype=np.float32), (count, 1)),
        np.full((count, 2), -5.0, np.float32), logits.astype(np.float32),
        np.zeros((count, 1, 3), np.float32),
    )  # fmt: skip
    found = visible_bounds(gaussians, UP)
    order = np.argsort(gaussians.means_world @ UP)
    heights, weights = (gaussians.means_world @ UP)[order], gaussians.opacities[order].astype(np.float64)
    below = np.cumsum(weights)
    total, reach = below[-1], np.exp(-5.0)
    low = heights[np.flatnonzero(below >= 0.002 * total)[0]] - reach
    high = heights[np.flatnonzero(total - below <= 0.002 * total + 1e-12)[0]] + reach
    assert found.half_height == pytest.approx((high - low) / 2, rel=1e-5)
    assert found.centre_world @ UP == pytest.approx((high + low) / 2, abs=1e-5)
