"""Whether materials are of use is judged by two short trainings, before a long one."""

import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.events import Event, Noted, Warned
from octasplat.engine.dataset import Dataset
from octasplat.engine.files.gaussian_ply import read_gaussian_ply
from octasplat.engine.pipeline import material_choice, reconstruct, train_step
from octasplat.engine.render.image_files import write_png
from octasplat.engine.runs.config import given_settings, read_config, resolve_config
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


FEW = ["iterations=2", "rays_per_batch=64", "initial_points=50", "max_gaussians=100", "test_every=4"]
TRIALS = "short trainings"


def gains(monkeypatch: pytest.MonkeyPatch, far_db: float, near_db: float = 0.0) -> list[str]:
    """Let trials have gains; return the list that their recipes are added to."""
    tried: list[str] = []

    def gain_db(*_arguments: object, recipe: str, **_named: object) -> float:
        tried.append(recipe)
        return near_db if recipe == "near_field" else far_db

    monkeypatch.setattr(material_choice, "material_gain_db", gain_db)
    monkeypatch.setattr(material_choice, "LONG_TRAINING_TRIALS", 0)
    return tried


def run_few(scene: Path, output: Path, *more: str, resume: bool = False) -> tuple[list[str], list[str]]:
    """Run a training of two iterations with materials; return its warnings and notes."""
    events: list[Event] = []
    assignments = [*FEW, *more]
    config = resolve_config("fast", settings={"exports": ()}, materials=True, assignments=assignments)
    given = given_settings({}, materials=True, assignments=assignments) if more else None
    reconstruct(scene, output, config, threads=1, progress=events.append, resume=resume, given=given)
    warned = [event.message for event in events if isinstance(event, Warned)]
    return warned, [event.message for event in events if isinstance(event, Noted)]


def learnt(output: Path) -> str:
    """Return the recipe by which a run has learnt materials; none if it has not."""
    materials = read_config(output / "config.json").train.materials
    return materials.recipe if materials.learn else "none"


@pytest.mark.parametrize(
    ("is_thing", "far_db", "near_db", "expected", "sentence"),
    [
        (False, -7.0, 1.5, "near_field", "1.5 dB better with materials.recipe=near_field"),
        (False, -0.4, -0.1, "none", "trained without materials"),
        pytest.param(False, -0.2, 9.0, "split_sum", None, marks=pytest.mark.exhaustive),
        pytest.param(True, -0.9, 9.0, "split_sum", None, marks=pytest.mark.exhaustive),
        (True, -1.5, 0.1, "split_sum", "Leave out --materials"),
    ],
)  # fmt: skip
def test_long_training_learns_what_explains_the_photographs(
    few_pixels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    is_thing: bool, far_db: float, near_db: float, expected: str, sentence: str | None,
) -> None:  # fmt: skip
    tried = gains(monkeypatch, far_db, near_db)
    scene = few_pixels
    if is_thing:
        scene = tmp_path / "thing"
        shutil.copytree(few_pixels, scene)
        (scene / "masks").mkdir()
        for photograph in (scene / "images").iterdir():
            write_png(scene / "masks" / f"{photograph.name}.png", np.ones((18, 24, 3), np.float32))
    warned, noted = run_few(scene, tmp_path / "run")
    assert any(TRIALS in message for message in noted)
    assert learnt(tmp_path / "run") == expected
    channels = read_gaussian_ply(tmp_path / "run" / "scene.ply")[0].channels
    assert ("metallic" in channels) == (expected != "none")
    loss = f"{-far_db:.1f} dB worse with materials than without"
    told = [message for message in warned if loss in message]
    assert len(told) == (sentence is not None) and (sentence is None or sentence in told[0])
    assert tried == (["split_sum"] if sentence is None or is_thing else ["split_sum", "near_field"])


def test_scene_that_materials_do_not_explain_is_as_without_them(
    few_pixels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gains(monkeypatch, -2.0, -1.0)
    run_few(few_pixels, tmp_path / "run")
    config = resolve_config("fast", settings={"exports": ()}, assignments=FEW)
    reconstruct(few_pixels, tmp_path / "plain", config, threads=1)
    scene, plain = ((tmp_path / name / "scene.ply").read_bytes() for name in ("run", "plain"))
    assert scene == plain


@pytest.mark.exhaustive
def test_choice_stays_when_the_run_goes_on(
    few_pixels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output = tmp_path / "run"
    tried = gains(monkeypatch, -7.0, 1.0)
    run_few(few_pixels, output)
    scene = (output / "scene.ply").read_bytes()
    shutil.rmtree(output / "checkpoints")
    (output / "scene.ply").unlink()
    tried.clear()
    run_few(few_pixels, output, resume=True)
    assert (output / "scene.ply").read_bytes() == scene
    assert tried == []
    moved = tmp_path / "moved"
    few_pixels.rename(moved)  # its place is written anew, and the choice with it
    try:
        run_few(moved, output, resume=True)
    finally:
        moved.rename(few_pixels)
    assert learnt(output) == "near_field"
    with pytest.raises(ConfigError, match="other settings"):
        run_few(few_pixels, output, "materials.fallback=false", resume=True)


@pytest.mark.parametrize(
    "given",
    [
        pytest.param("materials.fallback=false", marks=pytest.mark.exhaustive),
        pytest.param("materials.recipe=near_field", marks=pytest.mark.exhaustive),
        "materials.recipe=split_sum",
    ],
)
def test_what_is_asked_for_by_name_is_learnt_and_warned_of(
    few_pixels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str
) -> None:
    gains(monkeypatch, -7.0, -3.0)
    warned, _ = run_few(few_pixels, tmp_path / "run", given)
    assert sum("dB worse with materials than without" in message for message in warned) == 1
    assert learnt(tmp_path / "run") == ("near_field" if "near_field" in given else "split_sum")


@pytest.mark.exhaustive
def test_short_training_is_begun_without_a_trial(
    few_pixels: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gains(monkeypatch, -7.0)
    monkeypatch.setattr(material_choice, "LONG_TRAINING_TRIALS", 10**9)
    warned, noted = run_few(few_pixels, tmp_path / "run")
    assert not any(TRIALS in message for message in noted)
    assert not any("worse with materials" in message for message in warned)


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

    monkeypatch.setattr(material_choice, "material_gain_db", slow_trial)
    monkeypatch.setattr(material_choice, "LONG_TRAINING_TRIALS", 0)
    monkeypatch.setattr(train_step, "make_plan", note)
    few = ["rays_per_batch=64", "initial_points=50", "test_every=4"]
    settings = {"exports": (), "minutes": 0.5}
    config = resolve_config("fast", settings=settings, materials=True, assignments=few)
    reconstruct(few_pixels, tmp_path / "run", config, threads=1)
    assert 20 < seconds[0] <= 27
