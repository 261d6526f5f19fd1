"""What probes measure, and when they refuse a state."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import TrainingError
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import Tracer, TraceSettings
from octasplat.engine.train.loop.state import initial_state
from octasplat.engine.train.loop.validation_probe import ValidationProbe, draw_probe, measure_probe
from tests.support.planar_dataset import PlanarDataset


class SmallObject(PlanarDataset):
    """The part of the plane nearer than ``radius`` to the origin, on nothing."""

    def __init__(self, radius: float, **options: int) -> None:
        super().__init__(**options)
        self.radius = radius
        self.has_alpha = True

    def shown(self, rays: RayBatch) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rgb, _, weight = super().shown(rays)
        origins, directions = rays.origins_world, rays.directions_world
        points = origins - directions * (origins[:, 2:] / directions[:, 2:])
        inside = np.linalg.norm(points[:, :2], axis=1) < self.radius
        return rgb * inside[:, None], inside.astype(np.float32), weight


def disc(radius: float, rgb: float = 0.5) -> FlatGaussians:
    """One grey opaque Gaussian in the plane z = 0."""
    return FlatGaussians(
        np.zeros((1, 3), np.float32),
        np.array([[np.sqrt(0.5), 0, -np.sqrt(0.5), 0]], np.float32),  # its normal, the first axis, is along z
        np.full((1, 2), np.log(radius / 3), np.float32),
        np.full(1, 12.0, np.float32),
        np.full((1, 1, 3), (rgb - 0.5) / 0.28209479177387814, np.float32),
    )


def tracer_of(gaussians: FlatGaussians) -> Tracer:
    tracer = make_tracer(TraceSettings(), threads=1)
    tracer.build(gaussians)
    return tracer


def judge_of(world: PlanarDataset, folder: Path, rays: int) -> ValidationProbe:
    return ValidationProbe(
        world, folder, lambda _event: None,
        rays=rays, background_srgb=np.ones(3, np.float32), best_margin_db=0.3, seed=0,
    )  # fmt: skip


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(7))


def test_views_without_an_error_do_not_raise_the_probe(rng: np.random.Generator) -> None:
    world = SmallObject(radius=0.2, count=200)
    # Ten rays a view, most of which meet nothing.
    probe = draw_probe(world, world.train_indices, 2000, np.ones(3, np.float32), rng)
    psnr, _ = measure_probe(probe, world, tracer_of(disc(0.01)), PLAIN_SHADING)
    shown, alpha, _ = world.pixels(probe.view, probe.y, probe.x)
    assert 0.002 < alpha.mean() < 0.05
    truth = -10 * np.log10(((shown * alpha[:, None] - probe.background_srgb * alpha[:, None]) ** 2).mean())
    assert psnr == pytest.approx(truth, abs=0.2)


@pytest.mark.parametrize("radius", [0.02, 0.1])
def test_validation_probe_small_covered_object_is_accepted(radius: float, tmp_path: Path) -> None:
    world = SmallObject(radius=radius, count=40, side_px=120)
    gaussians = disc(2 * radius)
    judge = judge_of(world, tmp_path, 20_000)
    state = initial_state(gaussians, 0)
    state.iteration = 10
    judge.measure(state, tracer_of(gaussians), PLAIN_SHADING)
    assert [iteration for iteration, _ in state.probes] == [10]


def test_validation_probe_low_coverage_is_refused(tmp_path: Path) -> None:
    world = SmallObject(radius=0.5, count=10)
    gaussians = disc(0.01)
    judge = judge_of(world, tmp_path, 5000)
    state = initial_state(gaussians, 0)
    state.iteration = 10
    with pytest.raises(TrainingError, match=r"covers only .* % of the photographs, of which .* show"):
        judge.measure(state, tracer_of(gaussians), PLAIN_SHADING)
