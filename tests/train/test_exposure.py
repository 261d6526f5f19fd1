"""Exposures of the views: their gradients, and that they explain photographs of unlike brightness."""

from pathlib import Path

import numpy as np
import pytest
from flat_world import FlatWorld, small_config

from engine.errors import Cancelled
from engine.events import Event, HeldOutMeasured
from engine.train.checkpoint import TrainState, latest_checkpoint, load_checkpoint
from engine.train.config import TrainConfig
from engine.train.exposure import Exposures
from engine.train.trainer import Trainer, fresh_state


class UnevenWorld(FlatWorld):
    """Every training photograph has a brightness of its own; the held-out one has the mean of them."""

    def __init__(self) -> None:
        super().__init__()
        self.log_gains = np.array([0.0, 0.35, -0.3, 0.2, -0.25, 0.1, -0.1], np.float32)

    def pixels(
        self, view: np.ndarray, y: np.ndarray, x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rgb, alpha, weight = super().pixels(view, y, x)
        return 0.6 * rgb * np.exp(self.log_gains[view])[:, None], alpha, weight


def run(folder: Path, config: TrainConfig, *, stop_after: int | None = None) -> tuple[Trainer, list[Event]]:
    """Train on the uneven world; with ``stop_after``, stop there and go on from the checkpoint."""
    world, events = UnevenWorld(), list[Event]()
    state = fresh_state(world.start(), config.seed)

    def trainer(state: TrainState, last: float) -> Trainer:
        return Trainer(
            world, config, state, folder=folder, fingerprint="test", listener=events.append, threads=1,
            should_stop=lambda: state.iteration >= last,
        )  # fmt: skip

    if stop_after is not None:
        with pytest.raises(Cancelled):
            trainer(state, stop_after).run()
        path = latest_checkpoint(folder)
        assert path is not None
        state = load_checkpoint(path, "test")
    last = trainer(state, np.inf)
    last.run()
    return last, events


def last_psnr(events: list[Event]) -> float:
    return [event.psnr for event in events if isinstance(event, HeldOutMeasured)][-1]


def test_gradients_agree_with_finite_differences() -> None:
    rng = np.random.default_rng(0)
    exposures = Exposures.neutral(3)
    exposures.log_gains[:] = rng.normal(0, 0.3, (3, 3))
    exposures.offsets[:] = rng.normal(0, 0.1, (3, 3))
    view = np.array([0, 2, 2, 1])
    rgb, alpha = rng.random((4, 3), dtype=np.float32), rng.random(4, dtype=np.float32)
    gradient = rng.normal(size=(4, 3)).astype(np.float32)
    by_rgb, by_alpha = exposures.undevelop(view, gradient)
    step = np.float32(0.5)  # the map is linear, so that a large step is exact
    before = exposures.develop(view, rgb, alpha)
    for ray in range(4):
        more = alpha.copy()
        more[ray] += step
        moved = exposures.develop(view, rgb, more) - before
        assert by_alpha[ray] == pytest.approx((moved * gradient).sum() / step, abs=1e-5)
        for channel in range(3):
            brighter = rgb.copy()
            brighter[ray, channel] += step
            moved = exposures.develop(view, brighter, alpha) - before
            assert by_rgb[ray, channel] == pytest.approx((moved * gradient).sum() / step, abs=1e-5)


def test_known_gains_and_offsets_are_found() -> None:
    rng = np.random.default_rng(1)
    log_gains = rng.normal(0, 0.2, (4, 3))
    offsets = rng.normal(0, 0.05, (4, 3))
    log_gains -= log_gains.mean(axis=0)
    offsets -= offsets.mean(axis=0)
    exposures = Exposures.neutral(4)
    for iteration in range(2000):
        view = rng.integers(0, 4, 256)
        rgb, alpha = rng.random((256, 3)).astype(np.float32), np.ones(256, np.float32)
        target = np.exp(log_gains[view]) * rgb + offsets[view]
        error = exposures.develop(view, rgb, alpha) - target
        exposures.step(view, rgb, alpha, error.astype(np.float32), rate=0.02 * 0.01 ** (iteration / 2000))
    np.testing.assert_allclose(exposures.log_gains, log_gains, atol=2e-3)
    np.testing.assert_allclose(exposures.offsets, offsets, atol=2e-3)


def test_uneven_photographs_are_explained_by_their_exposure(tmp_path: Path) -> None:
    config = small_config(iterations=240, exposure=True, rates={"exposure": 0.02})
    trainer, events = run(tmp_path / "learnt", config)
    _, plain = run(tmp_path / "plain", small_config(iterations=240))
    assert last_psnr(events) > last_psnr(plain) + 2
    found = trainer.state.exposures
    assert found is not None
    world = UnevenWorld()
    true = world.log_gains[world.train_indices]
    mid = 0.3  # where offsets and gains are told apart by little, compare what they do to a middle tone
    shown = np.exp(found.log_gains[world.train_indices]) * mid + found.offsets[world.train_indices]
    expected = np.exp(true - true.mean())[:, None] * mid
    np.testing.assert_allclose(shown, np.repeat(expected, 3, axis=1), atol=0.02)
    assert (found.log_gains[world.test_indices] == 0).all()


def test_a_resumed_run_has_the_same_exposures(tmp_path: Path) -> None:
    config = small_config(exposure=True)
    whole, _ = run(tmp_path / "whole", config)
    parts, _ = run(tmp_path / "parts", config, stop_after=50)
    assert whole.state.exposures is not None and parts.state.exposures is not None
    assert whole.state.exposures.log_gains.tobytes() == parts.state.exposures.log_gains.tobytes()
    assert whole.state.gaussians.sh.tobytes() == parts.state.gaussians.sh.tobytes()


def test_without_the_setting_nothing_is_learnt(tmp_path: Path) -> None:
    trainer, _ = run(tmp_path, small_config())
    assert trainer.state.exposures is None
