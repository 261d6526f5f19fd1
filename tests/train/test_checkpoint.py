"""Checkpoints: all of the state, whole or refused."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import CheckpointError
from octasplat.engine.core.events import Event, Warned
from octasplat.engine.gaussians.rows import row_arrays
from octasplat.engine.train.loop.checkpoint import (
    BestState,
    latest_checkpoint,
    load_best,
    load_checkpoint,
    load_latest_checkpoint,
    save_best,
    save_checkpoint,
)
from octasplat.engine.train.loop.state import TrainState
from octasplat.engine.train.optimization.adam import Adam
from tests.support.planar_dataset import PlanarDataset


def make_state(iteration: int = 30, count: int = 12) -> TrainState:
    rng = np.random.default_rng(iteration)
    gaussians = PlanarDataset().initial_gaussians(count)
    adam = Adam.zeros(gaussians)
    adam.first[:] = rng.normal(size=adam.first.shape)
    adam.steps[:] = 7
    return TrainState(
        iteration=iteration, gaussians=gaussians, adam=adam, rng=rng, densifier={"errors": np.arange(5.0)},
        shading={"toy.light": np.arange(4.0)},
        seconds=1.25, running_mse=0.01, best_psnr=20.5, best_iteration=20,
    )  # fmt: skip


def test_checkpoint_round_trips(tmp_path: Path) -> None:
    state = make_state()
    path = save_checkpoint(state, tmp_path, "abc")
    back = load_checkpoint(path, "abc")
    for group in ("gaussians", "adam"):
        for name, array in row_arrays(getattr(state, group)).items():
            np.testing.assert_array_equal(row_arrays(getattr(back, group))[name], array)
    for name in ("iteration", "seconds", "running_mse", "best_psnr", "best_iteration"):
        assert getattr(back, name) == getattr(state, name)
    np.testing.assert_array_equal(back.densifier["errors"], np.arange(5.0))
    np.testing.assert_array_equal(back.shading["toy.light"], np.arange(4.0))
    np.testing.assert_array_equal(back.rng.random(9), state.rng.random(9))


def test_checkpoint_without_best_state_loads(tmp_path: Path) -> None:
    state = make_state(0)
    state.best_psnr, state.densifier = -np.inf, {}
    back = load_checkpoint(save_checkpoint(state, tmp_path, "abc"), "abc")
    assert back.best_psnr == -np.inf and back.densifier == {}


def test_newest_is_found_and_old_ones_go(tmp_path: Path) -> None:
    assert latest_checkpoint(tmp_path) is None
    for iteration in (5, 100, 20_000):
        path = save_checkpoint(make_state(iteration), tmp_path, "abc")
        assert latest_checkpoint(tmp_path) == path
    assert len(list(tmp_path.glob("*.npz"))) == 2


def test_checkpoint_of_other_settings_is_refused(tmp_path: Path) -> None:
    path = save_checkpoint(make_state(), tmp_path, "abc")
    with pytest.raises(CheckpointError, match="other settings"):
        load_checkpoint(path, "abd")


def test_damage_is_refused_or_harmless(tmp_path: Path) -> None:
    state = make_state()
    path = save_checkpoint(state, tmp_path, "abc")
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    damaged = [b"", b"no archive", whole[:100], whole[: len(whole) // 2], whole[:-1]]
    for place in rng.integers(0, len(whole), 300):
        damaged.append(
            whole[:place] + bytes([whole[place] ^ (1 << int(rng.integers(8)))]) + whole[place + 1 :]
        )
    refused = 0
    for content in damaged:
        path.write_bytes(content)
        try:
            back = load_checkpoint(path, "abc")
        except CheckpointError as error:
            assert str(path) in str(error)
            refused += 1
            continue
        for name, array in row_arrays(state.gaussians).items():
            np.testing.assert_array_equal(row_arrays(back.gaussians)[name], array)
        np.testing.assert_array_equal(back.adam.first, state.adam.first)
        np.testing.assert_array_equal(
            back.rng.bit_generator.state["state"], state.rng.bit_generator.state["state"]
        )
    assert refused > 100


def test_damaged_checkpoint_is_removed_and_nothing_is_asked_of_the_user(tmp_path: Path) -> None:
    save_checkpoint(make_state(10), tmp_path, "abc")
    path = save_checkpoint(make_state(20), tmp_path, "abc")
    path.write_bytes(b"no archive")
    heard: list[Event] = []
    state = load_latest_checkpoint(tmp_path, "abc", heard.append)
    assert state is not None and state.iteration == 10 and not path.exists()
    (warning,) = heard
    assert isinstance(warning, Warned) and f"{path} is damaged" in warning.message
    assert "delete" not in warning.message and "the one before it is taken" in warning.message


def test_checkpoint_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"iteration_0000001\.npz"):
        load_checkpoint(tmp_path / "iteration_0000001.npz", "abc")


def test_best_checkpoint_round_trips(tmp_path: Path) -> None:
    gaussians = PlanarDataset().initial_gaussians(20)
    corrections = np.random.default_rng(0).normal(size=(5, 6))
    save_best(BestState(gaussians, {"toy.light": np.arange(3.0)}, corrections), tmp_path)
    back = load_best(tmp_path)
    np.testing.assert_array_equal(back.gaussians.means_world, gaussians.means_world)
    np.testing.assert_array_equal(back.shading["toy.light"], np.arange(3.0))
    np.testing.assert_array_equal(back.pose_corrections, corrections)
    assert latest_checkpoint(tmp_path) is None
    (tmp_path / "best.npz").write_bytes(b"xx")
    with pytest.raises(CheckpointError, match=r"best\.npz"):
        load_best(tmp_path)
