"""The loop on a painted plane: it learns, it stops and goes on, it fails in words."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import CancelledError, DatasetError, TrainingError
from octasplat.engine.core.events import CheckpointWritten, Event, HeldOutMeasured, TrainingProgress, Warned
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.rows import row_arrays
from octasplat.engine.train.config import McmcConfig, RedisplatsConfig, TrainConfig
from octasplat.engine.train.loop.checkpoint import BestState, latest_checkpoint, load_checkpoint, save_best
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.loop.trainer import Trainer
from octasplat.engine.train.sampling.pixel_sampler import valid_pixel_fraction
from tests.support.planar_dataset import PlanarDataset, small_config


def train(
    folder: Path,
    config: TrainConfig,
    *,
    world: PlanarDataset | None = None,
    state: TrainState | None = None,
    threads: int = 1,
    should_stop: Callable[[], bool] = lambda: False,
) -> tuple[FlatGaussians, list[Event]]:
    world = world or PlanarDataset()
    events: list[Event] = []
    trainer = Trainer(
        world,
        config,
        state or initial_state(world.initial_gaussians(), config.seed),
        folder=folder,
        fingerprint="test",
        progress=events.append,
        threads=threads,
        should_stop=should_stop,
    )
    return trainer.run(), events


def content(gaussians: FlatGaussians) -> list[bytes]:
    return [array.tobytes() for array in row_arrays(gaussians).values()]


@pytest.fixture(scope="module")
def whole_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[FlatGaussians, list[Event]]:
    return train(tmp_path_factory.mktemp("whole"), small_config())


def test_trainer_reconstructs_plane(whole_run: tuple[FlatGaussians, list[Event]]) -> None:
    gaussians, events = whole_run
    held_out = [event.psnr for event in events if isinstance(event, HeldOutMeasured)]
    assert held_out[-1] > held_out[0] + 8
    assert gaussians.is_finite()
    assert gaussians.sh_degree == 1
    assert 300 < len(gaussians) <= 400


def test_trainer_emits_progress_events(whole_run: tuple[FlatGaussians, list[Event]]) -> None:
    gaussians, events = whole_run
    progress = [event for event in events if isinstance(event, TrainingProgress)]
    assert [event.iteration for event in progress] == list(range(10, 121, 10))
    assert progress[-1].gaussians == len(gaussians)
    assert progress[-1].seconds_left == 0 < progress[0].seconds_left
    assert all(event.rays_per_second > 0 and event.hits_per_ray > 0 for event in progress)
    assert [e.iteration for e in events if isinstance(e, CheckpointWritten)] == list(range(0, 121, 20))


def test_trainer_does_not_densify_before_densify_from(tmp_path: Path) -> None:
    _, events = train(tmp_path, small_config(densify_from_iter=75))
    counts = {e.iteration: e.gaussians for e in events if isinstance(e, TrainingProgress)}
    assert counts[70] == counts[10] < counts[90]


@pytest.mark.parametrize("threads", [1, 2])
def test_trainer_is_bit_identical_across_threads(
    whole_run: tuple[FlatGaussians, list[Event]], tmp_path: Path, threads: int
) -> None:
    assert content(train(tmp_path, small_config(), threads=threads)[0]) == content(whole_run[0])


def test_trainer_seed_changes_result(whole_run: tuple[FlatGaussians, list[Event]], tmp_path: Path) -> None:
    assert content(train(tmp_path, small_config(seed=1))[0]) != content(whole_run[0])


@pytest.mark.parametrize(
    "strategy",
    [
        pytest.param(McmcConfig(start=20, interval=20, growth=0.1), marks=pytest.mark.exhaustive),
        McmcConfig(start=20, interval=20, growth=0.1, error_power=1.0),
        RedisplatsConfig(start=20, interval=20, stop_fraction=0.9, step_threshold=1e-5),
    ],
    ids=["mcmc", "mcmc by error", "paper"],
)
def test_stopped_and_resumed_gives_the_same_bits(
    tmp_path: Path, strategy: McmcConfig | RedisplatsConfig
) -> None:
    config = small_config(densify=strategy.model_dump(), opacity_decay=0.95)
    expected, _ = train(tmp_path / "whole", config)
    assert len(expected) != 300
    asked = 0

    def stop_now_and_then() -> bool:
        nonlocal asked
        asked += 1
        return asked % 4 == 0

    folder, state, rounds = tmp_path / "stopped", None, 0
    while True:
        try:
            found, _ = train(folder, config, state=state, should_stop=stop_now_and_then)
            break
        except CancelledError as stop:
            assert "--resume" in str(stop)
        path = latest_checkpoint(folder)
        assert path is not None
        state = load_checkpoint(path, "test")
        rounds += 1
    assert rounds >= 2
    assert content(found) == content(expected)


def test_trainer_shared_sort_ends_at_configured_share(tmp_path: Path) -> None:
    world, config, orders = PlanarDataset(), small_config(shared_sort_until=0.5), dict[int, str]()
    Trainer(
        world, config, initial_state(world.initial_gaussians(), config.seed),
        folder=tmp_path, fingerprint="test",
        progress=lambda _event: None, threads=1,
        on_step=lambda iteration, tracer: orders.update({iteration: tracer.settings.sort}),
    ).run()  # fmt: skip
    assert {order for iteration, order in orders.items() if iteration <= 60} == {"packet"}
    assert {order for iteration, order in orders.items() if iteration > 60} == {"ray"}


def test_trainer_resume_of_finished_run_returns_result(tmp_path: Path) -> None:
    config = small_config(iterations=40)
    expected, _ = train(tmp_path, config)
    path = latest_checkpoint(tmp_path)
    assert path is not None
    found, _ = train(tmp_path, config, state=load_checkpoint(path, "test"))
    assert content(found) == content(expected)


def test_damaged_photograph_raises_error(tmp_path: Path) -> None:
    world = PlanarDataset()
    config = small_config()
    state = initial_state(world.initial_gaussians(), 0)
    world.poison = True
    with pytest.raises(TrainingError, match="damaged photographs"):
        train(tmp_path, config, world=world, state=state)


def test_nan_parameters_raise_error(tmp_path: Path) -> None:
    world = PlanarDataset()
    state = initial_state(world.initial_gaussians(), 0)
    state.gaussians.sh[:] = np.nan
    with pytest.raises(TrainingError):
        train(tmp_path, small_config(), world=world, state=state)


def test_divergent_learning_rate_raises_error(tmp_path: Path) -> None:
    config = small_config(lr={"mean": 1e6, "mean_final": 1e6})
    with pytest.raises(TrainingError, match="nothing is exported"):
        train(tmp_path, config)


def test_pruning_all_gaussians_raises_error(tmp_path: Path) -> None:
    strategy = RedisplatsConfig(start=20, interval=20, prune_opacity=0.999)
    with pytest.raises(TrainingError, match="removed every Gaussian"):
        train(tmp_path, small_config(densify=strategy.model_dump()))


def test_collapsed_end_gives_the_best_state(tmp_path: Path) -> None:
    config = small_config(iterations=40)
    train(tmp_path, config)
    path = latest_checkpoint(tmp_path)
    assert path is not None
    state = load_checkpoint(path, "test")
    best = PlanarDataset().initial_gaussians(50)
    save_best(BestState(best, {}), tmp_path)
    state.best_psnr = 90.0
    found, events = train(tmp_path, config, state=state)
    assert content(found) == content(best)
    assert any(isinstance(event, Warned) for event in events)


def test_white_background_and_alpha(tmp_path: Path) -> None:
    world = PlanarDataset()
    world.has_alpha = True
    for background in ("white", "auto"):
        gaussians, events = train(
            tmp_path / background, small_config(iterations=40, background=background), world=world
        )
        assert gaussians.is_finite()
        assert any(isinstance(event, HeldOutMeasured) for event in events)


def test_trainer_without_held_out_views_runs(tmp_path: Path) -> None:
    _, events = train(tmp_path, small_config(iterations=20), world=PlanarDataset(held_out=0))
    assert not any(isinstance(event, HeldOutMeasured) for event in events)


class Masked(PlanarDataset):
    """Nothing counts but, where there is one, the pixel at ``left``."""

    left: tuple[int, int, int] | None = None

    def pixels(
        self, view: np.ndarray, y: np.ndarray, x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rgb, alpha, weight = super().pixels(view, y, x)
        counts = np.zeros(len(x), np.bool_)
        if self.left is not None:
            counts = (view == self.left[0]) & (y == self.left[1]) & (x == self.left[2])
        return rgb, alpha, np.where(counts, weight, 0).astype(np.float32)


def test_trainer_empty_masks_are_refused_early(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="masks or alpha leave no pixel"):
        train(tmp_path, small_config(iterations=40), world=Masked())
    assert latest_checkpoint(tmp_path) is None
    world = Masked()
    world.left = (6, 3, 2)
    assert valid_pixel_fraction(world) > 0
