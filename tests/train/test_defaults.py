"""What settings of 0 stand for: sizes taken from the photographs."""

import pytest

from engine.train.config import TrainConfig, most_gaussians, preset, window_side_px


@pytest.mark.parametrize(
    ("pixels", "count"), [(1_000, 10_000), (500_000, 10_000), (5_000_000, 100_000), (46_000_000, 200_000)]
)
def test_most_gaussians_follow_the_pixels(pixels: int, count: int) -> None:
    assert most_gaussians(TrainConfig(), pixels) == count
    assert most_gaussians(TrainConfig(max_gaussians=777), pixels) == 777
    assert most_gaussians(preset("fast"), pixels) == 40_000


@pytest.mark.parametrize(("longest_px", "side_px"), [(4, 1), (480, 32), (800, 53), (960, 64), (4000, 267)])
def test_windows_follow_the_size_of_the_views(longest_px: int, side_px: int) -> None:
    assert window_side_px(TrainConfig(), longest_px) == side_px
    assert window_side_px(TrainConfig(window_side=20), longest_px) == 20
