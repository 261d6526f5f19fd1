"""A training that is given a time: what is chosen, and that it is kept."""

import json
from pathlib import Path

import pytest

from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.events import CheckpointWritten, Event, Warned
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.pipeline import reconstruct
from octasplat.engine.runs.config import resolve_config
from octasplat.engine.train.loop.time_budget import TimeBudgetPlan, choose_plan


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
