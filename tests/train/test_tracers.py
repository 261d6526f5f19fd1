"""Any tracer can train: the slow twin runs through the real trainer by its name in the settings alone."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.events import Event, HeldOutMeasured, TrainingProgress
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.train.initialization.initial_gaussians import (
    InitialGaussianOptions,
    initial_gaussians,
)
from octasplat.engine.train.loop.checkpoint import run_fingerprint
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.loop.trainer import Trainer
from tests.support.planar_dataset import PlanarDataset, small_config


def start() -> FlatGaussians:
    """Longer than wide, so that photographs say how each is turned in its plane."""
    gaussians = PlanarDataset().initial_gaussians(120)
    gaussians.log_scales[:, 1] += 0.3
    return gaussians


def train(folder: Path, tracer: str, iterations: int) -> tuple[TrainState, list[Event]]:
    world, events = PlanarDataset(), list[Event]()
    config = small_config(
        iterations=iterations, rays_per_batch=64, probe_rays=256, trace={"tracer": tracer},
        shared_sort_until=0, sh_degree_interval=20,
        densify={"kind": "mcmc", "start": 20, "interval": 20, "growth": 0.1},
    )  # fmt: skip
    trainer = Trainer(
        world, config, initial_state(start(), 0), folder=folder, fingerprint="test",
        progress=events.append, threads=1,
    )  # fmt: skip
    trainer.run()
    return trainer.state, events


@pytest.mark.exhaustive
def test_reference_tracer_trains_plane(tmp_path: Path) -> None:
    state, events = train(tmp_path, "reference", 110)
    held_out = [event.psnr for event in events if isinstance(event, HeldOutMeasured)]
    losses = [event.loss for event in events if isinstance(event, TrainingProgress)]
    assert held_out[-1] > held_out[0] + 4
    assert losses[-1] < losses[0] / 2
    assert state.gaussians.sh_degree == 1 and len(state.gaussians) > 120


def test_reference_tracer_first_steps_match_cpu_tracer(tmp_path: Path) -> None:
    slow, _ = train(tmp_path / "slow", "reference", 5)
    fast, _ = train(tmp_path / "fast", "cpu", 5)
    assert slow.running_mse == pytest.approx(fast.running_mse, rel=1e-4)
    first = start()
    for name in ("means_world", "quats_wxyz", "log_scales", "opacity_logits", "sh"):
        before, one, other = (getattr(state, name) for state in (first, slow.gaussians, fast.gaussians))
        moved = np.abs(one - before)
        assert moved.max() > 1e-3, name
        # The first steps of Adam follow signs, which rounding decides where a gradient is next to nothing.
        far = np.abs(one - other) > 1e-2 * moved.max()
        assert far.mean() < 0.02, name


@pytest.mark.exhaustive
@pytest.mark.heavy
def test_reference_tracer_trains_synthetic_scene(tmp_path: Path) -> None:
    root = tmp_path / "scene"
    write_synthetic_dataset(
        root, SyntheticDatasetConfig(views=6, width_px=32, height_px=24, samples_per_side=2, points=100)
    )
    dataset = Dataset.open(root, tmp_path / "cache", test_every=6)
    ends = {}
    for tracer in ("reference", "cpu"):
        config = small_config(
            iterations=50, rays_per_batch=64, probe_rays=256, trace={"tracer": tracer}, max_gaussians=100,
            checkpoint_every=50, initial_points=100, plane_sweep_init=False,
        )  # fmt: skip
        events: list[Event] = []
        state = initial_state(
            initial_gaussians(dataset, InitialGaussianOptions.from_config(config, dataset)), config.seed
        )
        Trainer(
            dataset, config, state, folder=tmp_path / tracer, fingerprint=run_fingerprint(dataset, config),
            progress=events.append, threads=1,
        ).run()  # fmt: skip
        psnr = [event.psnr for event in events if isinstance(event, HeldOutMeasured)]
        assert psnr[-1] > psnr[0] + 0.5, tracer
        ends[tracer] = psnr[-1]
    assert ends["reference"] == pytest.approx(ends["cpu"], abs=0.5)
    prints = {
        run_fingerprint(dataset, small_config(trace={"tracer": tracer})) for tracer in ("reference", "cpu")
    }
    assert len(prints) == 2
