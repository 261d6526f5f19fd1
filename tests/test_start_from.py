"""A training that begins with the scene of another run instead of the sparse points."""

import json
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from octasplat.engine.core.errors import CancelledError, ConfigError
from octasplat.engine.core.events import CheckpointWritten, Event, Noted, Warned
from octasplat.engine.files import export_scene, read_scene
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.pipeline import reconstruct
from octasplat.engine.pipeline.start_scene import keep_start
from octasplat.engine.render.environment_files import read_background_map
from octasplat.engine.runs.config import ReconstructionConfig, resolve_config
from octasplat.engine.train.loop.checkpoint import (
    BestState,
    latest_checkpoint,
    load_best,
    load_checkpoint,
    save_best,
    save_checkpoint,
)
from tests.support.tiny_dataset import make_tiny_dataset

pytestmark = pytest.mark.heavy

SETTINGS: dict[str, object] = {
    "rays_per_batch": 512,
    "sh_degree": 1,
    "max_gaussians": 400,
    "initial_points": 300,
    "probe_rays": 256,
    "exposure": True,
    "rebuild_every": 10,
    "checkpoint_every": 20,
}
UNCHANGED: dict[str, object] = {
    "iterations": 1,
    **{f"lr.{name}": 1e-9 for name in ("mean", "quat", "log_scale", "opacity", "color", "exposure")},
}


def make_config(**assignments: object) -> ReconstructionConfig:
    values = {**SETTINGS, **assignments}
    return resolve_config(
        "fast",
        settings={"exports": ()},
        assignments=[f"{name}={json.dumps(value)}" for name, value in values.items()],
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory, samples_per_side=2, points=300)


@pytest.fixture(scope="module")
def finished(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return reconstruct(scene, tmp_path_factory.mktemp("runs") / "finished", make_config(iterations=60))


def gaussians(run: Path) -> FlatGaussians:
    return read_scene(run)[0]


def exposures(run: Path) -> np.ndarray:
    """Gains and offsets of all views, in the order of their names."""
    found = json.loads((run / "training.json").read_text())["exposures"]
    return np.array([np.ravel(value) for _, view in sorted(found.items()) for value in view.values()])


def test_run_begins_with_gaussians_and_exposures_of_a_finished_one(
    scene: Path, finished: Path, tmp_path: Path
) -> None:
    unchanged = reconstruct(scene, tmp_path / "next", make_config(**UNCHANGED), start_from=finished)
    before, after = gaussians(finished), gaussians(unchanged)
    np.testing.assert_allclose(after.means_world, before.means_world, atol=1e-6)
    np.testing.assert_allclose(after.sh, before.sh, atol=1e-6)
    np.testing.assert_allclose(exposures(unchanged), exposures(finished), atol=1e-6)
    anew = reconstruct(scene, tmp_path / "anew", make_config(**UNCHANGED))
    assert abs(gaussians(anew).means_world.mean() - before.means_world.mean()) > 1e-4


def test_exposures_and_background_are_taken_from_the_files_of_a_run_without_checkpoints(
    scene: Path, tmp_path: Path
) -> None:
    learnt = {"background": "learnt", "background_height": 16}
    finished = reconstruct(scene, tmp_path / "finished", make_config(**learnt, iterations=60))
    shutil.rmtree(finished / "checkpoints")
    config = make_config(**learnt, **UNCHANGED, **{"lr.background": 1e-9})
    unchanged = reconstruct(scene, tmp_path / "next", config, start_from=finished)
    np.testing.assert_allclose(exposures(unchanged), exposures(finished), atol=1e-6)
    before, after = (read_background_map(run / "background.exr") for run in (finished, unchanged))
    assert np.ptp(before) > 0.01
    np.testing.assert_allclose(after, before, atol=1e-5)


def test_scene_of_the_best_state_comes_with_its_exposures(
    scene: Path, finished: Path, tmp_path: Path
) -> None:
    """Where the last state was much worse, the best one was exported, and what it had learnt with it."""
    run, output = tmp_path / "collapsed", tmp_path / "next"
    shutil.copytree(finished, run)
    path = latest_checkpoint(run / "checkpoints")
    assert path is not None
    last = load_checkpoint(path)
    gains = last.shading["exposure.log_gains"]
    best = BestState(last.gaussians, {**last.shading, "exposure.log_gains": gains + 0.5}, np.ones((2, 6)))
    save_best(best, run / "checkpoints")
    for collapsed in (False, True):
        last.probes = [*last.probes[:-1], (last.iteration, last.best_psnr - (4.0 if collapsed else 2.0))]
        save_checkpoint(last, run / "checkpoints", "any")
        output.mkdir(exist_ok=True)
        keep_start(scene, output, run, is_new=True)
        found = load_best(output / "start")
        np.testing.assert_array_equal(found.shading["exposure.log_gains"], gains + 0.5 * collapsed)
        assert len(found.pose_corrections) == 2 * collapsed


def test_depth_maps_that_are_added_keep_the_exposures(scene: Path, finished: Path, tmp_path: Path) -> None:
    measured = tmp_path / "measured"
    shutil.copytree(scene, measured)
    shutil.copytree(scene / "ground_truth" / "depth", measured / "depths")
    run = reconstruct(measured, tmp_path / "run", make_config(**UNCHANGED), start_from=finished)
    np.testing.assert_allclose(exposures(run), exposures(finished), atol=1e-6)


def test_stopped_run_is_gone_on_with_by_other_settings_to_the_same_bytes(scene: Path, tmp_path: Path) -> None:
    stopped, stop = tmp_path / "stopped", [False]

    def note(event: Event) -> None:
        stop[0] = stop[0] or isinstance(event, CheckpointWritten)

    with pytest.raises(CancelledError):
        reconstruct(scene, stopped, make_config(iterations=60), progress=note, should_stop=lambda: stop[0])
    assert not (stopped / "scene.ply").exists()
    other = make_config(iterations=40, sh_degree=0, exposure=False)
    told: list[str] = []
    whole = reconstruct(
        scene,
        tmp_path / "whole",
        other,
        start_from=stopped,
        progress=lambda event: told.append(event.message) if isinstance(event, Noted) else None,
    )
    assert any("learnt anew" in sentence for sentence in told)
    assert gaussians(whole).sh_degree == 0
    stop[0] = False
    parts = tmp_path / "parts"
    with pytest.raises(CancelledError):
        reconstruct(
            scene, parts, other, start_from=stopped, progress=note, should_stop=lambda: stop[0], threads=1
        )
    shutil.rmtree(stopped)  # the run has a copy of what it begins with
    reconstruct(scene, parts, other, resume=True)
    assert (parts / "scene.ply").read_bytes() == (whole / "scene.ply").read_bytes()
    with pytest.raises(ConfigError, match=r"parts was not begun with .*finished"):
        reconstruct(scene, parts, other, resume=True, start_from=tmp_path / "finished")


def test_file_of_gaussians_is_a_start(scene: Path, finished: Path, tmp_path: Path) -> None:
    path = tmp_path / "half.ply"
    half = gaussians(finished).select(slice(0, 100))
    export_scene(half, path)
    run = reconstruct(scene, tmp_path / "run", make_config(**UNCHANGED, max_gaussians=100), start_from=path)
    np.testing.assert_allclose(gaussians(run).means_world, half.means_world, atol=1e-6)


@pytest.mark.exhaustive
def test_time_budget_counts_all_gaussians_of_the_start(scene: Path, finished: Path, tmp_path: Path) -> None:
    path, output = tmp_path / "many.ply", tmp_path / "run"
    first = gaussians(finished)
    export_scene(first.select(np.resize(np.arange(len(first)), 5000)), path)
    config = make_config(max_gaussians=10_000, rays_per_batch=8192).model_copy(update={"minutes": 0.1})
    with pytest.raises(CancelledError):
        reconstruct(
            scene,
            output,
            config,
            start_from=path,
            should_stop=(output / "plan.json").exists,
            threads=1,
        )
    plan = json.loads((output / "plan.json").read_text())
    assert plan["gaussians"] == 5000 and plan["max_gaussians"] >= 5000  # none is taken away for the time


def test_unsuitable_starts_are_refused_and_leave_nothing(scene: Path, finished: Path, tmp_path: Path) -> None:
    output, empty = tmp_path / "run", tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(ConfigError, match=r"empty has neither scene.ply nor a checkpoint"):
        reconstruct(scene, output, make_config(), start_from=empty)
    with pytest.raises(ConfigError, match=r"Gaussians, and this run may have 50; .*--max-gaussians \d+"):
        reconstruct(scene, output, make_config(max_gaussians=50, initial_points=50), start_from=finished)
    moved = tmp_path / "moved"
    shutil.copytree(scene, moved)
    model = pycolmap.Reconstruction(str(moved / "sparse" / "0"))
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array([3.0, 0.0, 0.0])))
    model.write(str(moved / "sparse" / "0"))
    with pytest.raises(ConfigError, match=r"other poses than .*finished was trained with"):
        reconstruct(moved, output, make_config(), start_from=finished)
    assert [path.name for path in output.iterdir()] == ["cache"]  # for the corrected command


def test_views_trained_on_before_and_held_out_now_are_told(
    scene: Path, finished: Path, tmp_path: Path
) -> None:
    told: list[str] = []
    config = make_config(**UNCHANGED).model_copy(update={"test_every": 3})
    reconstruct(
        scene,
        tmp_path / "run",
        config,
        start_from=finished,
        progress=lambda event: told.append(event.message) if isinstance(event, Warned) else None,
    )
    assert any("held out here" in sentence and "too good" in sentence for sentence in told)
