"""What was begun by a version in which the same settings gave other results is not mixed with this one's."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import octasplat as osp
from octasplat.engine.blocks import block_scene
from octasplat.engine.core import versions
from octasplat.engine.core.events import CheckpointWritten, Event, Noted, TrainingProgress, Warned
from octasplat.engine.train.loop.checkpoint import latest_checkpoint
from tests.support.small_run import RUN_OPTIONS
from tests.support.tiny_dataset import make_tiny_dataset

OPTIONS: dict[str, Any] = {**RUN_OPTIONS, "exports": [], "threads": 1}
ANEW = "so it begins anew"


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory, width_px=48, height_px=36, points=300)


@pytest.fixture
def raise_results(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Let this be the next version, which gives other results."""
    return lambda: monkeypatch.setattr(versions, "RESULTS_VERSION", versions.RESULTS_VERSION + 1)


def resume(scene: Path, output: Path, **more: Any) -> tuple[list[str], list[Event]]:
    """Go on with a run; return what was told, and all events."""
    events: list[Event] = []
    osp.reconstruct(scene, output, resume=True, threads=1, progress=events.append, **more)
    return [event.message for event in events if isinstance(event, Warned | Noted)], events


def stop_at(iteration: int, scene: Path, output: Path) -> Path:
    """Begin a run that stops there; return its newest checkpoint."""
    osp.reconstruct(scene, output, **OPTIONS, on_step=lambda step: step.iteration < iteration)
    newest = latest_checkpoint(output / "checkpoints")
    assert newest is not None and not (output / "scene.ply").exists()
    return newest


def first_iteration(events: list[Event]) -> int:
    return next(event.iteration for event in events if isinstance(event, TrainingProgress))


def test_training_of_a_former_version_begins_anew_and_says_so(
    scene: Path, tmp_path: Path, raise_results: Callable[[], None]
) -> None:
    output = tmp_path / "run"
    stop_at(40, scene, output)
    raise_results()
    # even where the settings of that version have another digest
    for path in (output / "checkpoints").glob("iteration_*.npz"):
        rewrite_meta(path, fingerprint="of a former version")
    told, events = resume(scene, output)
    assert sum(ANEW in text for text in told) == 1 and first_iteration(events) < 40
    whole = osp.reconstruct(scene, tmp_path / "whole", **OPTIONS)
    assert (output / "scene.ply").read_bytes() == (whole.path / "scene.ply").read_bytes()
    told, _ = resume(scene, output)
    assert not told


@pytest.mark.parametrize("is_known", [True, False])
def test_checkpoint_that_does_not_state_its_results_is_of_the_last_version_that_did_not(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_known: bool
) -> None:
    monkeypatch.setattr(versions, "RESULTS_VERSION", versions.UNSTATED_RESULTS + (not is_known))
    path = stop_at(40, scene, tmp_path / "run")
    rewrite_meta(path, results=None)
    told, events = resume(scene, tmp_path / "run")
    assert any(ANEW in text for text in told) != is_known
    assert (first_iteration(events) > 40) == is_known


def rewrite_meta(path: Path, **changes: Any) -> None:
    """Change what a checkpoint says of itself; None removes a key."""
    with np.load(path) as archive:
        arrays = dict(archive)
    kept = {key: value for key, value in json.loads(str(arrays["meta"])).items() if key not in changes}
    new = {key: value for key, value in changes.items() if value is not None}
    arrays["meta"] = np.array(json.dumps(kept | new))
    np.savez(path, **arrays)


def test_scene_that_a_former_version_trained_stays_and_that_is_told(
    scene: Path, tmp_path: Path, raise_results: Callable[[], None]
) -> None:
    run = osp.reconstruct(scene, tmp_path / "run", **OPTIONS)
    trained = (run.path / "scene.ply").read_bytes()
    raise_results()
    told, _ = resume(scene, run.path)
    assert not any("stays as it is" in text for text in told)  # nothing is missing
    (run.path / "metrics.json").unlink()
    told, _ = resume(scene, run.path)
    assert sum("stays as it is" in text for text in told) == 1
    assert (run.path / "scene.ply").read_bytes() == trained and (run.path / "metrics.json").exists()


def test_photographs_that_a_former_version_decoded_are_decoded_again(
    scene: Path, tmp_path: Path, raise_results: Callable[[], None]
) -> None:
    stop_at(20, scene, tmp_path / "run")
    pixels = tmp_path / "run" / "cache" / "rgb.bin"
    decoded = pixels.read_bytes()
    pixels.write_bytes(bytes(len(decoded)))  # as another version might have
    told, _ = resume(scene, tmp_path / "run", on_step=lambda _step: False)
    assert not any("decoded again" in text for text in told) and pixels.read_bytes() != decoded
    raise_results()
    told, _ = resume(scene, tmp_path / "run", on_step=lambda _step: False)
    assert sum("decoded again" in text for text in told) == 1 and pixels.read_bytes() == decoded


@pytest.mark.parametrize("is_trained", [True, False])
def test_coarse_scene_of_a_former_version_is_trained_anew(
    scene: Path,
    tmp_path: Path,
    raise_results: Callable[[], None],
    monkeypatch: pytest.MonkeyPatch,
    is_trained: bool,
) -> None:
    output, stopped = tmp_path / "run", osp.CancelledError("before the plan")
    options = {**OPTIONS, "blocks": 2, "train": {"initial_points": 300, "checkpoint_every": 10}}

    def stop_in_training(event: Event) -> None:
        if isinstance(event, CheckpointWritten) and not is_trained:
            raise stopped

    with monkeypatch.context() as patch:
        patch.setattr(block_scene, "plan_blocks", raising(stopped))
        with pytest.raises(osp.CancelledError):
            osp.reconstruct(scene, output, **options, progress=stop_in_training)
    coarse = output / "blocks" / "coarse"
    assert (coarse / "best.npz").exists() == is_trained and not (output / "blocks" / "plan.npz").exists()
    if is_trained:
        (coarse / "best.npz").write_bytes(b"of a former version")
    raise_results()
    told, _ = resume(scene, output)
    assert sum("other results" in text and str(coarse) in text for text in told) == 1
    whole = osp.reconstruct(scene, tmp_path / "whole", **options)
    assert (output / "scene.ply").read_bytes() == (whole.path / "scene.ply").read_bytes()


def raising(error: Exception) -> Callable[..., Any]:
    def stop(*_of: Any, **_named: Any) -> Any:
        raise error

    return stop
