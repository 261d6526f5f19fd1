"""A training that is given a time: what is chosen, and that it is kept."""

import json
from pathlib import Path
from typing import Any

import pytest

from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.events import CheckpointWritten, Event, Warned
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.pipeline import reconstruct
from octasplat.engine.runs.config import resolve_config
from octasplat.engine.shading.deferred import DeferredShading
from octasplat.engine.shading.incident_light import IncidentLightModel
from octasplat.engine.shading.protocol import TracedRays
from octasplat.engine.train.initialization.initial_gaussians import initial_train_state
from octasplat.engine.train.loop import trial_training
from octasplat.engine.train.loop.time_budget import TimeBudgetPlan, choose_plan
from octasplat.engine.train.loop.trial_training import seconds_per_iteration


def test_time_budget_larger_buys_more_gaussians() -> None:
    plans = [choose_plan(seconds, 0.05, 40_000, 200_000) for seconds in (100, 300, 3000, 30_000)]
    for plan in plans:
        assert plan.seconds_an_iteration == 0.05 and plan.gaussians == 40_000
    for plan in plans[:3]:
        used = plan.iterations * 0.05 * (plan.max_gaussians / 40_000) ** 0.8
        assert used == pytest.approx(plan.seconds, rel=0.01)
    assert plans[0].iterations == pytest.approx(2000, abs=2)
    assert plans[0].max_gaussians == pytest.approx(40_000, abs=5)
    assert [plan.max_gaussians for plan in plans] == sorted(plan.max_gaussians for plan in plans)
    assert plans[3].max_gaussians == 200_000 and plans[3].iterations == 70_000  # nothing more to be had


def test_time_budget_zero_still_trains() -> None:
    plan = choose_plan(-3.0, 0.05, 40_000, 200_000)
    assert (plan.iterations, plan.max_gaussians) == (100, 2_000)


@pytest.mark.exhaustive
def test_time_budget_plan_is_saved_and_reused(tmp_path: Path) -> None:
    scene, output = tmp_path / "scene", tmp_path / "run"
    write_synthetic_dataset(
        scene, SyntheticDatasetConfig(views=8, width_px=48, height_px=36, samples_per_side=1, points=300)
    )
    config = resolve_config(
        "fast",
        settings={"exports": (), "minutes": 0.1},
        assignments=["rays_per_batch=256", "probe_rays=256", "checkpoint_every=25", "iterations=9"],
    )
    events: list[Event] = []

    def stop() -> bool:
        return sum(isinstance(event, CheckpointWritten) for event in events) >= 2

    with pytest.raises(CancelledError):
        reconstruct(scene, output, config, threads=1, progress=events.append, should_stop=stop)
    assert any(
        isinstance(event, Warned) and "iterations=9 is passed over" in event.message for event in events
    )
    plan = TimeBudgetPlan.model_validate_json((output / "plan.json").read_text())
    assert plan.seconds < 6 and plan.max_gaussians <= 8 * 48 * 36
    short = plan.model_copy(update={"iterations": 75})  # a plan is what counts, not the pace of today
    (output / "plan.json").write_text(short.model_dump_json())
    for checkpoint in (output / "checkpoints").iterdir():
        checkpoint.unlink()
    reconstruct(scene, output, config, resume=True, threads=1)
    assert json.loads((output / "training.json").read_text())["iterations"] == 75


@pytest.mark.parametrize(("secondary_from", "traces"), [(0.05, True), (1.0, False)])
def test_pace_with_materials_is_that_of_iterations_with_reflections(
    secondary_from: float, traces: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    traced: list[float] = []
    trace_incident = DeferredShading._trace_incident

    def counted(self: DeferredShading, traced_rays: TracedRays, *args: Any) -> IncidentLightModel:
        if traced_rays.view is not None:  # of a batch, not of a probe
            traced.append(traced_rays.training_progress)
        return trace_incident(self, traced_rays, *args)

    monkeypatch.setattr(DeferredShading, "_trace_incident", counted)
    monkeypatch.setattr(trial_training, "WARM_UP_ITERATIONS", 2)
    monkeypatch.setattr(trial_training, "TIMED_ITERATIONS", 3)
    write_synthetic_dataset(
        tmp_path / "scene",
        SyntheticDatasetConfig(views=6, width_px=24, height_px=18, samples_per_side=1, points=100),
    )
    dataset = Dataset.open(tmp_path / "scene", tmp_path / "cache", threads=1)
    materials = {"environment_height": 16, "secondary_from": secondary_from, "ambient_occlusion": False}
    settings: dict[str, Any] = {"rays_per_batch": 64, "initial_points": 50, "max_gaussians": 100}
    config = resolve_config("fast", materials=True, train={**settings, "materials": materials}).train
    first = initial_train_state(dataset, config).gaussians
    seconds_per_iteration(dataset, config, first, threads=1)
    assert bool(traced) is traces
