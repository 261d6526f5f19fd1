"""States of a training for the 3D view are few, small and cheap, and change nothing."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from octasplat.engine.core.events import Event
from octasplat.engine.dataset import Dataset
from octasplat.engine.files import read_scene
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.pipeline import reconstruct
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.protocol import Tracer
from octasplat.service.web.cameras import read_view_poses
from octasplat.service.web.results import read_json_content
from octasplat.workers.storage.local import LocalStorage
from octasplat.workers.worker import live_scene
from octasplat.workers.worker.live_scene import LiveSceneWriter, LiveSceneWritten, heaviest
from tests.support.tiny_dataset import make_tiny_dataset
from tests.support.watched_training import watched_config


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory, width_px=48, height_px=36, points=500)


def test_states_of_a_training_are_written_with_its_cameras_and_change_nothing(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = reconstruct(scene, tmp_path / "whole", watched_config(), threads=1)
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(live_scene, "time", SimpleNamespace(monotonic=lambda: clock.now))
    monkeypatch.setattr(live_scene, "MAX_GAUSSIANS", 100)
    told: list[Event] = []
    run = tmp_path / "run"
    live = LiveSceneWriter(run, told.append)

    def watch(
        iteration: int, dataset: Dataset, _tracer: Tracer, _shading: ShadingModel, gaussians: FlatGaussians
    ) -> None:
        clock.now += 4.0
        live(iteration, dataset, gaussians)

    reconstruct(scene, run, watched_config(), threads=1, on_step=watch)
    steps = [event.step for event in told if isinstance(event, LiveSceneWritten)]
    assert steps[0] == 1 and 10 <= len(steps) <= 16  # every 15 s of 240, later a twentieth of the time
    for name in ("scene.ply", "mesh.ply", "checkpoints/best.npz", "renders/view_000.png"):
        assert (run / name).read_bytes() == (whole / name).read_bytes()
    written = read_scene(run / live_scene.SCENE_FILE)[0]
    assert len(written) == 100 == told[-1].gaussians and written.sh_degree == 0  # type: ignore[attr-defined]
    storage = LocalStorage(tmp_path / "store", floor_bytes=0)
    with storage.open_writer(size_bytes=(run / live_scene.VIEWS_FILE).stat().st_size) as writer:
        writer.write((run / live_scene.VIEWS_FILE).read_bytes())
        content = read_json_content(storage, writer.commit().sha256)
    assert len(read_view_poses(content)) == len(content["views"]) > 3
    held_out = json.loads((run / "held_out.json").read_text())
    assert [view["name"] for view in content["views"] if view["held_out"]] == held_out != []


def test_files_take_no_more_than_a_hundredth_of_the_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now=0.0, spent=0.0)
    monkeypatch.setattr(live_scene, "time", SimpleNamespace(monotonic=lambda: clock.now))

    def slow(*_arguments: object) -> None:
        clock.now += 2.0
        clock.spent += 2.0

    live = LiveSceneWriter(tmp_path, lambda _event: None)
    monkeypatch.setattr(live, "_write", slow)
    gaussians = FlatGaussians(
        means_world=np.zeros((1, 3), np.float32),
        quats_wxyz=np.ones((1, 4), np.float32),
        log_scales=np.zeros((1, 2), np.float32),
        opacity_logits=np.zeros(1, np.float32),
        sh=np.zeros((1, 1, 3), np.float32),
    )
    dataset = SimpleNamespace(views=(), test_indices=(), viewpoints=None)
    step: Callable[..., None] = live
    while clock.now < 3600:
        clock.now += 0.1
        step(1, dataset, gaussians)
    assert 0 < clock.spent <= 0.011 * clock.now


def test_heaviest_are_those_with_the_most_opacity_times_area() -> None:
    rng = np.random.default_rng(0)
    gaussians = FlatGaussians(
        means_world=rng.normal(size=(50, 3)).astype(np.float32),
        quats_wxyz=np.ones((50, 4), np.float32),
        log_scales=np.zeros((50, 2), np.float32),
        opacity_logits=np.zeros(50, np.float32),
        sh=rng.normal(size=(50, 9, 3)).astype(np.float32),
    )
    gaussians.log_scales[[3, 11]] = 1.0
    gaussians.opacity_logits[20] = 5.0
    kept = heaviest(gaussians, 3)
    np.testing.assert_array_equal(kept.means_world, gaussians.means_world[[3, 11, 20]])
    assert kept.sh.shape == (3, 1, 3) and len(heaviest(gaussians, 60)) == 50


def test_sparse_points_are_shown_before_the_training(scene: Path, tmp_path: Path) -> None:
    told: list[Event] = []
    live = LiveSceneWriter(tmp_path, told.append)
    live.write_points(scene, None)
    [event] = told
    assert isinstance(event, LiveSceneWritten) and event.step == 0 and 300 < event.gaussians <= 500
    assert len(read_scene(tmp_path / event.path)[0]) == event.gaussians
    live.write_points(tmp_path, None)  # not a scene: the run says so itself
    assert len(told) == 1


def test_sparse_points_are_of_the_model_that_the_run_takes(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    scene = make_tiny_dataset(tmp_path_factory, width_px=48, height_px=36)
    other = make_tiny_dataset(tmp_path_factory, width_px=48, height_px=36, views=5)
    shutil.copytree(other / "sparse" / "0", scene / "sparse" / "1")
    live = LiveSceneWriter(tmp_path, lambda _event: None)
    for model, views in ((None, 8), ("1", 5)):
        live.write_points(scene, None, model)
        assert len(json.loads((tmp_path / live_scene.VIEWS_FILE).read_text())["views"]) == views
