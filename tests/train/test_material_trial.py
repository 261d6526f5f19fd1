"""Whether materials are of use is judged by two short trainings, before a long one."""

import time
from pathlib import Path
from typing import Any

import pytest

from octasplat.engine.core.events import Event, Noted, Warned
from octasplat.engine.dataset import Dataset
from octasplat.engine.pipeline import reconstruct, train_step
from octasplat.engine.runs.config import resolve_config
from octasplat.engine.train.loop import trial_training
from octasplat.engine.train.loop.time_budget import TimeBudgetPlan, make_plan
from octasplat.engine.train.loop.trial_training import material_gain_db
from tests.support.tiny_dataset import make_tiny_dataset


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory)


@pytest.fixture(scope="module")
def few_pixels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs of runs whose accuracy says nothing."""
    return make_tiny_dataset(tmp_path_factory, width_px=24, height_px=18)


@pytest.mark.exhaustive
@pytest.mark.heavy
def test_materials_of_matt_things_lose_accuracy(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("iterations", 120), ("rays_per_batch", 1024)):
        monkeypatch.setitem(trial_training.MATERIAL_TRIAL_SETTINGS, name, value)
    monkeypatch.setattr(trial_training, "MATERIAL_PROBE_RAYS", 2048)
    dataset = Dataset.open(scene, tmp_path, max_side=64, test_every=4, threads=2)
    assert material_gain_db(dataset, background="black", seed=0, threads=2) < -1.0


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("gain_db", "share", "told"),
    [
        (-4.0, 0, 1),
        pytest.param(0.5, 0, 0, marks=pytest.mark.exhaustive),
        pytest.param(-4.0, 10**9, 0, marks=pytest.mark.exhaustive),
    ],
)
def test_long_training_with_useless_materials_is_warned_of(
    few_pixels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gain_db: float, share: int, told: int
) -> None:
    monkeypatch.setattr(train_step, "material_gain_db", lambda *_arguments, **_named: gain_db)
    monkeypatch.setattr(train_step, "LONG_TRAINING_TRIALS", share)
    events: list[Event] = []
    few = ["iterations=2", "rays_per_batch=64", "initial_points=50", "max_gaussians=100", "test_every=4"]
    config = resolve_config("fast", settings={"exports": ()}, materials=True, assignments=few)
    reconstruct(few_pixels, tmp_path / "run", config, threads=1, progress=events.append)
    warned = [event.message for event in events if isinstance(event, Warned)]
    assert sum("4.0 dB worse with materials than without" in message for message in warned) == told
    assert sum("materials.recipe=near_field" in message for message in warned) == told
    assert any(isinstance(event, Noted) and "short trainings" in event.message for event in events) == (
        share == 0
    )


@pytest.mark.exhaustive
def test_time_of_the_trial_is_part_of_the_minutes(
    few_pixels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seconds: list[float] = []
    planned = make_plan

    def slow_trial(*_arguments: object, **_named: object) -> float:
        time.sleep(3.0)
        return 0.0

    def note(*arguments: Any, **named: Any) -> TimeBudgetPlan:
        seconds.append(named["seconds"])
        plan = planned(*arguments, **named)
        return plan.model_copy(update={"iterations": 2, "max_gaussians": 100})

    monkeypatch.setattr(train_step, "material_gain_db", slow_trial)
    monkeypatch.setattr(train_step, "LONG_TRAINING_TRIALS", 0)
    monkeypatch.setattr(train_step, "make_plan", note)
    few = ["rays_per_batch=64", "initial_points=50", "test_every=4"]
    settings = {"exports": (), "minutes": 0.5}
    config = resolve_config("fast", settings=settings, materials=True, assignments=few)
    reconstruct(few_pixels, tmp_path / "run", config, threads=1)
    assert 20 < seconds[0] <= 27
