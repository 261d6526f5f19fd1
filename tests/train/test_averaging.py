"""The mean of the last states: what it is, when it begins anew, and that it survives a checkpoint."""

from pathlib import Path

import numpy as np

from octasplat.engine.gaussians.rows import row_arrays
from octasplat.engine.train.config import TrainConfig
from octasplat.engine.train.loop.checkpoint import load_checkpoint, save_checkpoint
from octasplat.engine.train.loop.schedule import Schedule
from octasplat.engine.train.loop.state import initial_state
from octasplat.engine.train.optimization.weight_averaging import AVERAGING_INTERVAL, WeightAverage
from tests.support.planar_dataset import random_gaussians


def test_average_of_added_states() -> None:
    states = [random_gaussians(12, seed=seed) for seed in range(5)]
    mean = WeightAverage()
    for state in states:
        mean.add(state)
    assert mean.gaussians is not None and mean.count == 5
    for name, found in row_arrays(mean.gaussians).items():
        expected = np.mean([row_arrays(state)[name] for state in states], axis=0)
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_average_equals_float32_arithmetic() -> None:
    states = [random_gaussians(500, seed=seed, degree=2) for seed in range(4)]
    mean, expected = WeightAverage(), states[0].sh.copy()
    for count, state in enumerate(states, start=1):
        mean.add(state)
        expected += (state.sh - expected) * np.float32(1.0 / count)
    assert mean.gaussians is not None
    np.testing.assert_array_equal(mean.gaussians.sh, expected)


def test_averaging_restarts_for_new_parameters() -> None:
    mean = WeightAverage()
    mean.add(random_gaussians(12, seed=0))
    wider = random_gaussians(12, seed=1, degree=1)
    mean.add(wider)
    assert mean.gaussians is not None and mean.count == 1
    np.testing.assert_array_equal(mean.gaussians.sh, wider.sh)
    wider.sh[:] = 0  # the mean is a copy
    assert mean.gaussians.sh.any()


def test_averaging_state_survives_checkpoint(tmp_path: Path) -> None:
    state = initial_state(random_gaussians(12, seed=0), seed=0)
    assert load_checkpoint(save_checkpoint(state, tmp_path, "x"), "x").average.gaussians is None
    for seed in range(3):
        state.average.add(random_gaussians(12, seed=seed))
    again = load_checkpoint(save_checkpoint(state, tmp_path, "x"), "x").average
    assert again.count == 3 and again.gaussians is not None and state.average.gaussians is not None
    for name, found in row_arrays(again.gaussians).items():
        np.testing.assert_array_equal(found, row_arrays(state.average.gaussians)[name])


def test_averaging_starts_at_configured_iteration() -> None:
    schedule = Schedule.from_config(TrainConfig(weight_averaging_start=0.5), 100)
    assert [k for k in range(1, 101) if schedule.is_averaging_due(k)] == list(
        range(60, 101, AVERAGING_INTERVAL)
    )
    assert not any(
        Schedule.from_config(TrainConfig(weight_averaging_start=1), 100).is_averaging_due(k)
        for k in range(1, 101)
    )
    assert [k for k in range(1, 101) if schedule.is_averaging(k)] == list(range(51, 101))
    assert Schedule.from_config(TrainConfig(), 17).is_averaging_due(17)  # the last one always
