"""What settings of 0 stand for: sizes taken from the photographs."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.settings.preset_names import PRESETS
from octasplat.engine.train.config import (
    LossWeights,
    TrainConfig,
    iteration_count,
    max_gaussian_count,
    preset,
    ray_patch_side_px,
    rebuild_interval,
    uses_shared_sort,
    with_materials,
)
from octasplat.engine.train.loop.schedule import Schedule
from octasplat.engine.train.loop.state import initial_state
from octasplat.engine.train.loop.trainer import Trainer
from octasplat.engine.train.sampling.pixel_sampler import valid_pixel_fraction
from tests.support.planar_dataset import PlanarDataset, small_config


@pytest.mark.parametrize(
    ("pixels", "counts"),
    [
        (38_000, (3_800,) * 4),
        (500_000, (16_666, 16_666, 16_666, 10_000)),
        (1_000_000, (33_333, 33_333, 33_333, 20_000)),
        (5_552_160, (50_000, 185_072, 185_072, 111_043)),  # fox, 480 px
        (46_000_000, (50_000, 400_000, 600_000, 350_000)),
    ],
)
def test_default_max_gaussians_scales_with_pixels(pixels: int, counts: tuple[int, ...]) -> None:
    for name, count in zip(PRESETS, counts, strict=True):
        assert max_gaussian_count(preset(name), pixels) == count
        assert max_gaussian_count(preset(name).model_copy(update={"max_gaussians": 777}), pixels) == 777


@pytest.mark.parametrize(
    ("longest_px", "each_px", "side_px", "own_order_px"),
    [
        (4, 50, 1, 1),
        (480, 0.01, 1, 32),
        (480, 50, 17, 32),
        (800, 117, 26, 53),
        (960, 1000, 64, 64),
        (4000, 160, 31, 267),
    ],
)
def test_windows_follow_the_gaussians_or_the_views(
    longest_px: int, each_px: float, side_px: int, own_order_px: int
) -> None:
    assert ray_patch_side_px(TrainConfig(), longest_px, each_px) == side_px
    assert ray_patch_side_px(TrainConfig(shared_sort_until=0), longest_px, each_px) == own_order_px
    assert ray_patch_side_px(with_materials(TrainConfig()), longest_px, each_px) == own_order_px
    assert ray_patch_side_px(TrainConfig(ray_patch_side=20), longest_px, each_px) == 20


def test_default_sort_depends_on_trained_parameters() -> None:
    assert TrainConfig().trace.sort == "ray"
    for config in (
        TrainConfig(shared_sort_until=0),
        with_materials(TrainConfig()),
        TrainConfig(loss=LossWeights(depth_normal=0.05)),
        preset("redisplats"),
    ):
        assert not uses_shared_sort(config)
        assert not Schedule.from_config(config, iteration_count(config, 10**6)).uses_shared_sort(0)
    schedule = Schedule.from_config(TrainConfig(), iteration_count(TrainConfig(), 10**6))
    assert [schedule.uses_shared_sort(done) for done in (0, 5_599, 5_600, 7_000)] == [
        True,
        True,
        False,
        False,
    ]


@pytest.mark.parametrize(
    ("pixels", "count"),
    [(1_000, 7), (20_000_000, 9), (33_000_000, 14), (46_900_000, 20), (10**9, 23)],
)
def test_large_scenes_train_longer(pixels: int, count: int) -> None:
    count *= 1000
    assert iteration_count(TrainConfig(), pixels) == count
    assert iteration_count(TrainConfig(iterations=7), pixels) == 7
    assert iteration_count(preset("fast"), pixels) == 2500
    assert iteration_count(preset("redisplats"), pixels) == 10_000
    assert 2.5 * count < iteration_count(preset("high"), pixels) <= 3.5 * count
    assert iteration_count(TrainConfig(shared_sort_until=0), pixels) == max(5000, round(3 / 7 * count, -3))


@pytest.mark.parametrize(
    ("shown", "gaussians", "count"), [(1.0, 400_000, 8000), (0.7, 400_000, 11_000), (0.31, 202_533, 23_000)]
)
def test_default_counts_ignore_empty_pixels(shown: float, gaussians: int, count: int) -> None:
    assert max_gaussian_count(TrainConfig(), 19_600_000, shown) == gaussians
    assert iteration_count(TrainConfig(), 19_600_000, shown) == count
    assert iteration_count(preset("fast"), 19_600_000, shown) == 2500
    assert iteration_count(with_materials(preset("fast")), 19_600_000) == 1400
    materials = with_materials(TrainConfig())
    assert iteration_count(materials, 19_600_000) == 19_000
    assert iteration_count(materials, 1_000_000) == 10_000
    assert iteration_count(materials, 19_600_000, shown) == iteration_count(materials, 19_600_000)


@pytest.mark.parametrize("hidden", ["alpha", "weight"])
def test_covered_pixel_share(hidden: str) -> None:
    class Half(PlanarDataset):
        def pixels(
            self, view: np.ndarray, y: np.ndarray, x: np.ndarray
        ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            rgb, alpha, weight = super().pixels(view, y, x)
            shown = {"alpha": alpha, "weight": weight}
            shown[hidden] = np.where(x < 20, 0, shown[hidden])
            return rgb, shown["alpha"], shown["weight"]

    assert valid_pixel_fraction(PlanarDataset()) == 1
    assert valid_pixel_fraction(Half()) == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(("wanted", "count"), [(0, 7000), (80, 80)])
def test_trainer_iterations_default(tmp_path: Path, wanted: int, count: int) -> None:
    world, config = PlanarDataset(), small_config(iterations=wanted)
    state = initial_state(world.initial_gaussians(), config.seed)
    trainer = Trainer(
        world, config, state, folder=tmp_path, fingerprint="test", progress=lambda _event: None, threads=1
    )
    assert trainer.schedule.iterations == count


def test_default_iterations_decrease_with_rays_per_batch() -> None:
    assert iteration_count(TrainConfig(rays_per_batch=32_768), 70_000_000) == 15_000


@pytest.mark.parametrize(("gaussians", "iterations"), [(499_999, 25), (500_000, 50), (1_000_000, 75)])
def test_large_hierarchies_are_rebuilt_less_often(gaussians: int, iterations: int) -> None:
    assert rebuild_interval(TrainConfig().rebuild_every, gaussians) == iterations
    assert rebuild_interval(10, gaussians) == 10 * iterations // 25
