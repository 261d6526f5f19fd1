"""A run that is stopped, or killed at any moment, goes on and ends with the same bytes."""

import json
import random
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import numba
import pytest

from octasplat.engine.core.errors import (
    CancelledError,
    CheckpointError,
    ConfigError,
    OutputError,
    TrainingError,
)
from octasplat.engine.core.events import CheckpointWritten, Event
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.pipeline import reconstruct
from octasplat.engine.runs.config import ReconstructionConfig, resolve_config
from tests.support.killable_run import start_run
from tests.support.tiny_dataset import make_tiny_dataset

pytestmark = pytest.mark.heavy

ITERATIONS, EVERY = 300, 25
FILES = ["octagons.ply", "octagons.obj", "octagons.glb"]
WITH_SURFACE = {"exports": [*FILES, "viewer.glb", "surface.glb"]}
"""All that a run exports by itself; the surface takes three times as long as the rest of the run."""


def make_config(**assignments: object) -> ReconstructionConfig:
    values: dict[str, object] = {
        "iterations": ITERATIONS,
        "rays_per_batch": 1024,
        "ssim_patch_fraction": 0.25,
        "ssim_patch_side": 16,
        "sh_degree": 1,
        "sh_degree_interval": 100,
        "max_gaussians": 900,
        "initial_points": 500,
        "densify_from_iter": 40,
        "densify.start": 50,
        "densify.interval": 30,
        "densify.growth": 0.1,
        "rebuild_every": EVERY,
        "checkpoint_every": EVERY,
        "probe_rays": 512,
        "exports": FILES,
        **assignments,
    }
    return resolve_config("standard", assignments=[f"{k}={json.dumps(v)}" for k, v in values.items()])


@pytest.fixture(autouse=True)
def threads_as_before() -> Iterator[None]:
    before = numba.get_num_threads()
    yield
    numba.set_num_threads(before)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory, samples_per_side=2, points=600)


@pytest.fixture(scope="module")
def whole_run(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same run without an interruption, on one thread."""
    return reconstruct(scene, tmp_path_factory.mktemp("whole") / "run", make_config(), threads=1)


@pytest.fixture(scope="module")
def surface_run(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with all that a run exports."""
    output = tmp_path_factory.mktemp("surface") / "run"
    return reconstruct(scene, output, make_config(**WITH_SURFACE), threads=1)


def results(run: Path) -> dict[str, bytes]:
    """Every file of a finished run that must not depend on its history."""
    paths = [path for path in run.iterdir() if path.suffix in (".ply", ".obj", ".glb", ".mtl", ".png")]
    paths += [run / "held_out.json", *sorted((run / "renders").rglob("*.png"))]
    content = {str(path.relative_to(run)): path.read_bytes() for path in sorted(paths) if path.name[0] != "."}
    metrics = json.loads((run / "metrics.json").read_text())
    content["metrics"] = json.dumps(without_times(metrics), sort_keys=True).encode()
    return content


def without_times(value: object) -> object:
    if isinstance(value, dict):
        return {k: without_times(v) for k, v in value.items() if "second" not in k}
    return [without_times(item) for item in value] if isinstance(value, list) else value


def assert_same(run: Path, expected: Path) -> None:
    found, wanted = results(run), results(expected)
    assert found.keys() == wanted.keys()
    assert [name for name in wanted if found[name] != wanted[name]] == []


def lines_of(run: Path) -> list[str]:
    events = run / "events.jsonl"
    return events.read_text(encoding="utf-8", errors="replace").splitlines() if events.exists() else []


def kill_when(process: ForkServerProcess, ready: Callable[[], bool], delay: float) -> bool:
    """Kill a run ``delay`` seconds after ``ready``; False if it ended by itself before that."""
    deadline = time.monotonic() + 120
    while not ready() and process.is_alive():
        assert time.monotonic() < deadline, "the run does not get on"
        time.sleep(0.002)
    time.sleep(delay)
    process.kill()  # which does nothing to one that has ended
    process.join()
    assert process.exitcode in (0, -signal.SIGKILL)
    return process.exitcode != 0


def finish(scene: Path, run: Path, config: ReconstructionConfig, threads: int) -> None:
    process = start_run(scene, run, config.model_dump_json(), threads)
    process.join(timeout=180)
    assert process.exitcode == 0


@pytest.mark.exhaustive
def test_killed_while_training_again_and_again(scene: Path, whole_run: Path, tmp_path: Path) -> None:
    moments = random.Random(11)
    run = tmp_path / "run"
    kills = 0
    for attempt in range(5):
        process = start_run(scene, run, make_config().model_dump_json(), threads=1 + attempt % 2)
        enough = len(lines_of(run)) + moments.randint(1, 14)
        alive = kill_when(
            process, lambda enough=enough: len(lines_of(run)) >= enough, moments.uniform(0, 0.08)
        )
        kills += alive
        if not alive:
            break
    assert kills >= 3
    finish(scene, run, make_config(), threads=2)
    assert_same(run, whole_run)
    iterations = [json.loads(line).get("iteration", 0) for line in lines_of(run) if line.startswith("{")]
    assert max(iterations) == ITERATIONS


@pytest.mark.exhaustive
@pytest.mark.parametrize("stage", ["load", "evaluate", "export"])
def test_killed_in_another_stage(scene: Path, surface_run: Path, tmp_path: Path, stage: str) -> None:
    moments = random.Random(stage)
    run, config = tmp_path / "run", make_config(**WITH_SURFACE)
    if stage != "load":
        # Everything up to the stage is there already, as it would be.
        shutil.copytree(surface_run, run)
        (run / "events.jsonl").write_text("")
        leftovers = ["octagons.obj", "octagons.glb"] + (
            ["metrics.json", "report.html"] if stage == "evaluate" else []
        )
        for name in leftovers:
            (run / name).unlink()

    def begun() -> bool:
        return any(f'"stage": "{stage}"' in line for line in lines_of(run))

    killed = 0
    for _ in range(2):
        before = len(lines_of(run))
        killed += kill_when(
            start_run(scene, run, config.model_dump_json(), threads=2),
            lambda before=before: begun() and len(lines_of(run)) > before,
            moments.uniform(0, 0.1),
        )
    finish(scene, run, config, threads=1)
    assert_same(run, surface_run)


@pytest.mark.exhaustive
def test_pipeline_independent_of_threads(scene: Path, surface_run: Path, tmp_path: Path) -> None:
    run = reconstruct(scene, tmp_path / "run", make_config(**WITH_SURFACE), threads=2)
    assert_same(run, surface_run)


def test_pipeline_stopped_run_resumes_to_same_bytes(scene: Path, whole_run: Path, tmp_path: Path) -> None:
    run, rounds = tmp_path / "run", 0
    seen: list[Event] = []
    while True:
        asked = 0

        def stop_soon() -> bool:
            nonlocal asked
            asked += 1
            # A surface is exported from its beginning again, and would never be done.
            return asked > 4 and not (run / "scene.ply").exists()

        try:
            reconstruct(
                scene, run, make_config(), resume=True, threads=1, progress=seen.append, should_stop=stop_soon
            )
            break
        except CancelledError:
            assert not (run / "scene.ply").exists()
            rounds += 1
    assert rounds >= 2
    assert_same(run, whole_run)
    written = [event.iteration for event in seen if isinstance(event, CheckpointWritten)]
    assert written == sorted(set(written)) and written[-1] == ITERATIONS


def test_damaged_checkpoint_is_passed_over(scene: Path, whole_run: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    with pytest.raises(CancelledError):
        reconstruct(scene, run, make_config(), threads=1, should_stop=stop_after(5))
    newest = max((run / "checkpoints").glob("iteration_*.npz"))
    newest.write_bytes(newest.read_bytes()[:1000])
    reconstruct(scene, run, make_config(), resume=True, threads=1)
    assert_same(run, whole_run)
    assert any("damaged" in line for line in lines_of(run))


def stop_after(times: int) -> Callable[[], bool]:
    asked = iter(range(1_000_000))
    return lambda: next(asked) >= times


def test_resume_of_different_run_is_refused(scene: Path, whole_run: Path, tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="--resume"):
        reconstruct(scene, whole_run, make_config())
    with pytest.raises(ConfigError, match="other settings"):
        reconstruct(scene, whole_run, make_config(seed=3), resume=True)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="not empty"):
        reconstruct(scene, tmp_path, make_config(), resume=True)


@pytest.mark.parametrize(
    "folder",
    [
        "plain",
        "damaged",
    ],
)
def test_checkpoints_of_other_photographs_are_refused_and_kept(
    scene: Path, tmp_path: Path, folder: str
) -> None:
    run = tmp_path / folder / "run"
    with pytest.raises(CancelledError):
        reconstruct(scene, run, make_config(), threads=1, should_stop=stop_after(3))
    before = sorted(path.name for path in (run / "checkpoints").iterdir())
    other = tmp_path / "other"
    write_synthetic_dataset(
        other,
        SyntheticDatasetConfig(views=8, width_px=64, height_px=48, samples_per_side=1, points=600, seed=5),
    )
    shutil.rmtree(run / "cache")
    with pytest.raises(CheckpointError, match="other photographs"):
        reconstruct(other, run, make_config(), resume=True, threads=1)
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == before


def test_failed_training_writes_no_exports(scene: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    config = make_config(**{"lr.mean": 1e6, "lr.mean_final": 1e6})
    with pytest.raises(TrainingError):
        reconstruct(scene, run, config, threads=1)
    names = {path.name for path in run.iterdir()}
    assert not names & {
        "scene.ply",
        "octagons.ply",
        "octagons.obj",
        "octagons.glb",
        "metrics.json",
        "report.html",
    }


def test_pipeline_resume_of_finished_run_changes_nothing(
    scene: Path, whole_run: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(whole_run, run)
    stamps = {path: path.stat().st_mtime_ns for path in run.glob("*.*") if path.name != "events.jsonl"}
    reconstruct(scene, run, make_config(), resume=True, threads=1)
    assert {path: path.stat().st_mtime_ns for path in stamps if path.name != "held_out.json"} == {
        path: stamp for path, stamp in stamps.items() if path.name != "held_out.json"
    }
