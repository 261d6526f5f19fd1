"""A sky behind everything: its gradients, that a known one is recovered, and where it is kept."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.dataset import Camera
from octasplat.engine.dataset.model import SparsePoints
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.render.environment_files import read_background_map, write_background_map
from octasplat.engine.shading.background import LearnedBackground
from octasplat.engine.shading.exposure import ExposureModel
from octasplat.engine.shading.protocol import ShadedRayGradients, TracedRays
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import TraceResult
from octasplat.engine.train.initialization.initial_background import estimate_background
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.loop.trainer import Trainer
from octasplat.engine.train.shading_factory import find_background
from tests.support.planar_dataset import PlanarDataset, batch_source, plane_texture, small_config
from tests.support.stopped_run import train_with_a_stop


def sky(directions: np.ndarray) -> np.ndarray:
    """The true color of a direction: brighter up (-y), redder to the right."""
    return np.stack(
        [0.5 + 0.3 * directions[:, 0], 0.5 - 0.3 * directions[:, 1], 0.6 + 0 * directions[:, 2]], axis=1
    ).astype(np.float32)


class UnderTheSky(PlanarDataset):
    """The painted plane is a disc; around it the photographs show the sky."""

    def pixels(
        self, view: np.ndarray, y: np.ndarray, x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rgb, alpha, weight = super().pixels(view, y, x)
        rays = self.rays(view, y, x)
        points = rays.origins_world - rays.directions_world * (
            rays.origins_world[:, 2:] / rays.directions_world[:, 2:]
        )
        beside = np.hypot(points[:, 0], points[:, 1]) > 0.6
        rgb[beside] = sky(rays.directions_world[beside])
        return rgb, alpha, weight

    def initial_gaussians(self, count: int = 300, opacity: float = 0.1) -> FlatGaussians:
        """Grey Gaussians on the disc."""
        first = super().initial_gaussians(3 * count, opacity)
        return first.select(np.flatnonzero(np.hypot(*first.means_world[:, :2].T) < 0.6))

    @property
    def cameras(self) -> tuple[Camera, ...]:
        side = float(self.side_px)
        return (Camera("SIMPLE_PINHOLE", (side, side / 2, side / 2), self.side_px, self.side_px),)

    @property
    def points(self) -> SparsePoints:
        """Points of the disc."""
        rng = np.random.default_rng(2)
        radius, turn = 0.6 * np.sqrt(rng.random(3000)), rng.uniform(0, 2 * np.pi, 3000)
        xyz = np.stack([radius * np.cos(turn), radius * np.sin(turn), 0 * turn], axis=1).astype(np.float32)
        counts = np.full(len(xyz), 3, np.int32)
        return SparsePoints(
            xyz,
            plane_texture(xyz[:, 0], xyz[:, 1]),
            counts,
            np.zeros(len(xyz), np.float32),
            np.arange(len(xyz)),
        )


def sight(directions: np.ndarray, rgb: np.ndarray, transmittance: np.ndarray) -> TracedRays:
    """A sight of given colors and transmittances."""
    zeros, three = np.zeros(len(rgb), np.float32), np.zeros((len(rgb), 3), np.float32)
    seen = TraceResult(
        rgb_srgb=rgb, transmittance=transmittance, depth_sum=zeros, depth_median=zeros, normal_world=three,
        features=three[:, :0], hit_counts=np.zeros(len(rgb), np.int32),
    )  # fmt: skip
    return TracedRays(RayBatch(three, directions), seen, CpuTracer(), np.zeros(len(rgb), np.int64))


def some_sight(rng: np.random.Generator, count: int = 5) -> TracedRays:
    directions = rng.normal(size=(count, 3))
    directions[0] = (0.0, -1.0, 0.0)  # straight up, where all columns meet
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rgb = rng.random((count, 3), dtype=np.float32)
    return sight(directions.astype(np.float32), rgb, rng.random(count, dtype=np.float32))


def train(
    folder: Path, *, threads: int = 1, stop_after: int | None = None, **changes: object
) -> tuple[Trainer, UnderTheSky]:
    """Train on the disc under the sky; with ``stop_after``, stop there and go on from the checkpoint."""
    world = UnderTheSky()
    config = small_config(background="learnt", background_height=16, lr={"background": 0.05}, **changes)
    state = initial_state(world.initial_gaussians(), config.seed)

    def trainer(state: TrainState, last: float) -> Trainer:
        return Trainer(
            world, config, state, folder=folder, fingerprint="test", progress=lambda _event: None,
            threads=threads, should_stop=lambda: state.iteration >= last,
        )  # fmt: skip

    return train_with_a_stop(trainer, state, folder, stop_after)[0], world


def test_gradients_agree_with_finite_differences() -> None:
    rng = np.random.default_rng(0)
    background = LearnedBackground(16)
    background.set_map(rng.random((16, 32, 3), dtype=np.float32))
    before = some_sight(rng)
    by_rgb = rng.normal(size=(5, 3)).astype(np.float32)
    nothing = np.zeros(5, np.float32)
    found = background.backward(before, background.shade(before), ShadedRayGradients(by_rgb, nothing))

    def loss(seen: TracedRays = before) -> float:
        developed = background.shade(seen)
        assert (developed.transmittance == 0).all()
        return float((developed.rgb_srgb.astype(np.float64) * by_rgb).sum())

    step = np.float32(0.25)  # the map is linear in all of these, so that a large step is exact
    assert found.trace.transmittance is not None and found.trace.rgb_srgb is not None
    np.testing.assert_array_equal(found.trace.rgb_srgb, by_rgb)
    for ray in range(5):
        more = before.result.transmittance.copy()
        more[ray] += step
        moved = (loss(replace(before, result=replace(before.result, transmittance=more))) - loss()) / step
        assert found.trace.transmittance[ray] == pytest.approx(moved, abs=1e-5)
    background.accumulate(found.parameters)
    sums = background.sums
    assert (np.abs(sums).sum(axis=2) > 0).sum() <= 4 * 5
    for row, column, channel in [*np.argwhere(sums != 0)[::7].tolist(), [8, 3, 1]]:
        background.rgb_srgb[row, column, channel] += step
        above = loss()
        background.rgb_srgb[row, column, channel] -= step
        assert sums[row, column, channel] == pytest.approx((above - loss()) / step, abs=1e-5)


def test_background_recovers_known_sky(tmp_path: Path) -> None:
    trainer, world = train(tmp_path, iterations=240)
    background = find_background(trainer.shading)
    assert background is not None
    view = np.repeat(world.train_indices, 40)
    row = np.tile(np.arange(40), len(world.train_indices))
    edge = world.rays(view, row, np.full(len(row), 1)).directions_world
    np.testing.assert_allclose(background.lookup(edge), sky(edge), atol=0.05)
    assert trainer.views is not None and trainer.views.as_dict()["psnr"] > 27


def test_background_initialises_from_photographs() -> None:
    world = UnderTheSky()
    first = estimate_background(world)
    view = np.repeat(world.train_indices, 40)
    column = np.tile(np.arange(40), len(world.train_indices))
    above = world.rays(view, np.full(len(view), 2), column).directions_world
    shown, _, _ = world.pixels(view, np.full(len(view), 2), column)
    open_sky = (shown == sky(above)).all(axis=1)
    above, shown = above[open_sky], shown[open_sky]
    assert np.abs(first.map.lookup(above) - shown).mean() < 0.02
    below = world.rays(view, np.full(len(view), 37), column).directions_world
    assert first.is_above_horizon(above.astype(np.float64)).all()
    assert not first.is_above_horizon(below.astype(np.float64)).any()
    enlarged = first.resize(128)
    assert enlarged.shape == (128, 256, 3)
    other = LearnedBackground(len(enlarged))
    other.set_map(enlarged)
    again = other.lookup(above)
    np.testing.assert_allclose(again, first.map.lookup(above), atol=0.02)


@pytest.mark.exhaustive
def test_background_training_is_deterministic(tmp_path: Path) -> None:
    whole, _ = train(tmp_path / "whole", threads=1)
    two, _ = train(tmp_path / "two", threads=2)
    parts, _ = train(tmp_path / "parts", stop_after=50)
    assert {"background.rgb_srgb", "background.sums", "background.steps"} <= whole.state.shading.keys()
    for other in (two, parts):
        assert whole.state.gaussians.sh.tobytes() == other.state.gaussians.sh.tobytes()
        for name, values in whole.state.shading.items():
            assert values.tobytes() == other.state.shading[name].tobytes(), name


def test_background_is_exposed_with_foreground(tmp_path: Path) -> None:
    trainer, _ = train(tmp_path, exposure=True)
    assert isinstance(trainer.shading, ExposureModel) and find_background(trainer.shading) is not None


def test_files_keep_the_colors(tmp_path: Path) -> None:
    colors = np.random.default_rng(0).random((16, 32, 3)).astype(np.float32)
    write_background_map(tmp_path / "background.exr", colors)
    np.testing.assert_allclose(read_background_map(tmp_path / "background.exr"), colors, atol=1e-6)


def test_map_of_another_size_is_shown(tmp_path: Path) -> None:
    write_background_map(tmp_path / "background.exr", np.full((8, 16, 3), 0.25, np.float32))
    background = LearnedBackground(16)
    background.set_map(read_background_map(tmp_path / "background.exr"))
    np.testing.assert_allclose(background.lookup(np.eye(3, dtype=np.float32)), 0.25, atol=1e-6)


def test_map_that_is_not_twice_as_wide_as_high_is_refused(tmp_path: Path) -> None:
    write_background_map(tmp_path / "background.exr", np.zeros((8, 8, 3), np.float32))
    with pytest.raises(ConfigError, match=r"background\.exr: is 8 x 8 pixels"):
        read_background_map(tmp_path / "background.exr")


def test_photographs_with_alpha_show_no_background() -> None:
    world = UnderTheSky()
    world.has_alpha = True
    with pytest.raises(ConfigError, match="alpha"):
        batch_source(world, small_config(background="learnt"))


def test_materials_have_a_light_of_their_own() -> None:
    with pytest.raises(ValueError, match="materials"):
        small_config(background="learnt", materials={"learn": True})
