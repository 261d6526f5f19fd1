"""A training ends before its time where nothing more is gained, and only there."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.events import CheckpointWritten, Event, TrainingProgress, Warned
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.rows import row_arrays
from octasplat.engine.train.config import TrainConfig
from octasplat.engine.train.loop.checkpoint import latest_checkpoint, load_checkpoint
from octasplat.engine.train.loop.schedule import Schedule, early_stop_iteration, has_converged
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.loop.trainer import Trainer
from tests.support.planar_dataset import PlanarDataset, small_config

RISING = [(k, 20 + k / 100) for k in range(0, 1001, 100)]


@pytest.mark.parametrize(
    ("probed", "least_db", "ends"),
    [
        (RISING, 0.5, False),  # two dB in a fifth
        (RISING, 2.5, True),
        ([*RISING, (1100, 30.0), (1200, 30.02)], 0.05, True),
        ([*RISING, (1100, 29.0), (1200, 30.3)], 0.05, False),  # a dip, then better than ever
        ([*RISING, (1100, 30.3), (1200, 29.0)], 0.05, False),
        ([(0, 10.0), (100, 30.0), (200, 30.0), (300, 30.0)], 0.05, False),  # too early to tell
        ([(1000, 30.0)], 0.05, False),
        ([], 0.05, False),
        ([*RISING, (1100, 30.0), (1200, 30.0)], 0.0, False),
    ],
)
def test_early_stopping_detects_plateau(probed: list[tuple[int, float]], least_db: float, ends: bool) -> None:
    assert has_converged(probed, 1000, least_db) == ends


def test_early_stopping_shortened_schedule_ends_training() -> None:
    """Rates go on from where they are to where they were to go, nothing is added, the last states count."""
    whole = Schedule.from_config(TrainConfig(), 1000)
    short = whole.stop_early(500)
    assert short.iterations == early_stop_iteration(500, 1000) == 700
    shares = [short.training_progress(k) for k in range(500, 701)]
    assert (
        shares[0] == whole.training_progress(500) == 0.5 and shares[-1] == 1 and (np.diff(shares) > 0).all()
    )
    assert whole.may_densify(510) and not short.may_densify(510)
    assert [k for k in range(1, 701) if short.is_averaging_due(k)] == list(range(600, 701, 10))
    assert short.is_finished(700) and short.is_validation_due(700) and not short.is_finished(699)
    assert (
        Schedule.from_config(TrainConfig(weight_averaging_start=0.1), 1000)
        .stop_early(500)
        .is_averaging_due(510)
    )
    assert (
        not Schedule.from_config(TrainConfig(weight_averaging_start=0.1), 1000)
        .stop_early(500)
        .is_averaging_due(500)
    )


class NoisyWorld(PlanarDataset):
    """Photographs of the painted plane with noise, which is soon all that is left to learn."""

    def pixels(
        self, view: np.ndarray, y: np.ndarray, x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rgb, *rest = super().pixels(view, y, x)
        noise = np.random.default_rng(5).normal(0, 0.2, (len(self.views), self.side_px, self.side_px, 3))
        return (rgb + noise[view, y, x].astype(np.float32), *rest)


def config_of(**changes: object) -> TrainConfig:
    values: dict[str, object] = {
        "iterations": 200,
        "early_stopping_db": 0.2,
        "rays_per_batch": 512,
        "ssim_patch_fraction": 0.0,
    }
    return small_config(**{**values, **changes})


def trained(
    folder: Path, config: TrainConfig, state: TrainState | None = None, threads: int = 1, stop_at: int = -1
) -> tuple[FlatGaussians, list[Event], Trainer]:
    world, events = NoisyWorld(), list[Event]()
    trainer = Trainer(
        world, config, state or initial_state(world.initial_gaussians(), config.seed),
        folder=folder, fingerprint="test",
        progress=events.append, threads=threads, should_stop=lambda: trainer.state.iteration == stop_at,
    )  # fmt: skip
    return trainer.run(), events, trainer


def content(gaussians: FlatGaussians) -> list[bytes]:
    return [array.tobytes() for array in row_arrays(gaussians).values()]


@pytest.fixture(scope="module")
def short_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[FlatGaussians, list[Event], Trainer]:
    return trained(tmp_path_factory.mktemp("short"), config_of())


def test_early_stopping_ends_training(short_run: tuple[FlatGaussians, list[Event], Trainer]) -> None:
    gaussians, events, trainer = short_run
    decided = trainer.state.early_stop_at
    assert decided is not None and 80 <= decided < 160
    assert trainer.state.iteration == decided + 40 < 200
    told = [event.message for event in events if isinstance(event, Warned)]
    assert len(told) == 1 and f"ends after {decided + 40} of 200" in told[0]
    progress = {e.iteration: e for e in events if isinstance(e, TrainingProgress)}
    assert max(progress) == decided + 40
    assert {e.total_iterations for k, e in progress.items() if k <= decided} == {200}
    assert {e.total_iterations for k, e in progress.items() if k > decided} == {decided + 40}
    assert progress[decided + 40].seconds_left == 0
    assert len({e.gaussians for k, e in progress.items() if k > decided}) == 1
    assert len([e for e in events if isinstance(e, CheckpointWritten) and e.iteration == decided + 40]) == 1
    assert len(gaussians) == progress[decided + 40].gaussians


def test_early_stopped_average_is_exported(
    short_run: tuple[FlatGaussians, list[Event], Trainer], tmp_path: Path
) -> None:
    single, _, trainer = trained(tmp_path, config_of(weight_averaging_start=1.0))
    assert trainer.state.iteration == short_run[2].state.iteration
    assert content(single) != content(short_run[0])


@pytest.mark.parametrize("after", [0, 20])
def test_stopped_and_resumed_it_ends_at_the_same_bytes(
    short_run: tuple[FlatGaussians, list[Event], Trainer], tmp_path: Path, after: int
) -> None:
    expected, _, whole = short_run
    assert whole.state.early_stop_at is not None
    with pytest.raises(CancelledError, match=f"of {whole.state.iteration}; "):
        trained(tmp_path, config_of(), threads=2, stop_at=whole.state.early_stop_at + after)
    path = latest_checkpoint(tmp_path)
    assert path is not None
    found, events, trainer = trained(tmp_path, config_of(), state=load_checkpoint(path, "test"))
    assert trainer.state.iteration == whole.state.iteration
    assert content(found) == content(expected)
    assert not any(isinstance(event, Warned) for event in events)


def test_early_stopping_disabled_runs_all_iterations(
    short_run: tuple[FlatGaussians, list[Event], Trainer], tmp_path: Path
) -> None:
    _, events, trainer = trained(tmp_path, config_of(early_stopping_db=0.0))
    assert trainer.state.iteration == 200 and trainer.state.early_stop_at is None
    assert not any(isinstance(event, Warned) for event in events)
    decided = short_run[2].state.early_stop_at
    assert decided is not None
    losses = [
        {e.iteration: e.loss for e in run if isinstance(e, TrainingProgress) and e.iteration <= decided}
        for run in (events, short_run[1])
    ]
    assert losses[0] == losses[1]
