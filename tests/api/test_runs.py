"""Runs from Python: begun, stopped, gone on with, in threads, with their progress told."""

import json
import logging
import shutil
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import octasplat as osp
from octasplat.engine.core.events import Event, PhaseFinished, TrainingProgress
from octasplat.engine.render.image_files import read_image
from tests.support.small_run import RUN_OPTIONS


def test_run_stopped_by_on_step_resumes_to_same_bytes(
    photographs: Path, finished_run: Path, tmp_path: Path
) -> None:
    seen: list[int] = []

    def stop(step: TrainingProgress) -> bool:
        seen.append(step.iteration)
        return step.iteration < 20

    run = osp.reconstruct(photographs, tmp_path / "run", **RUN_OPTIONS, on_step=stop)
    assert seen == [10, 20]
    assert not run.is_finished and run.psnr is None and "unfinished" in repr(run)
    run = osp.reconstruct(photographs, run, resume=True, on_step=lambda step: seen.append(step.iteration))
    assert seen == [10, 20, 30, 40, 50, 60]
    assert run.is_finished
    assert (run.path / "scene.ply").read_bytes() == (finished_run / "scene.ply").read_bytes()


def test_should_stop_raises_and_on_step_does_not(photographs: Path, tmp_path: Path) -> None:
    with pytest.raises(osp.CancelledError):
        osp.reconstruct(photographs, tmp_path / "run", **RUN_OPTIONS, should_stop=lambda: True)


def test_run_exposes_metrics(finished_run: Path) -> None:
    run = osp.Run(finished_run)
    measured = osp.evaluate(run)
    assert run.psnr == measured.psnr and set(run.views) == set(measured.views)
    assert run.report.is_file() and run.settings["train"]["iterations"] == 60
    assert len(osp.load(run)) == len(run.scene)
    assert f"{run.psnr:.2f} dB" in repr(run)
    assert "psnr" in run._repr_html_() and "dB" in measured._repr_html_()


def test_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(osp.ConfigError, match=r"holds no config\.json"):
        osp.Run(tmp_path)


@pytest.mark.parametrize(
    "options",
    [
        {"preset": "fastest"},
        {"set": ["iteratoins=3"]},
        {"set": {"iteratoins": 3}},
        {"set": "lr.quat"},
        {"train": {"raise": 3}},
    ],
)
def test_refused_settings_have_the_sentence_of_the_command(
    options: dict[str, Any], photographs: Path, tmp_path: Path
) -> None:
    from octasplat.engine.core.errors import OctasplatError
    from octasplat.engine.operations.reconstruct import options_from_json

    with pytest.raises(OctasplatError) as expected:
        options_from_json(options).config()
    with pytest.raises(OctasplatError) as found:
        osp.reconstruct(photographs, tmp_path / "run", **options)
    assert str(found.value) == str(expected.value)
    assert not (tmp_path / "run").exists()


def test_python_means_the_settings_of_the_request(photographs: Path, tmp_path: Path) -> None:
    from octasplat.engine.operations.reconstruct import ReconstructOptions

    run = osp.reconstruct(photographs, tmp_path / "run", **RUN_OPTIONS, on_step=lambda _step: False)
    assert run.settings == ReconstructOptions.model_validate(RUN_OPTIONS).config().model_dump(mode="json")


def test_reconstruct_in_thread_logs_and_prints_nothing(
    scene_file: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    capfd: pytest.CaptureFixture[str],
) -> None:
    failed: list[BaseException] = []

    def work() -> None:
        try:
            camera = {"camera": (0, 0, -4), "look_at": (0, 0, 0), "width_px": 32, "height_px": 24}
            osp.render(scene_file, tmp_path / "a.png", **camera)  # type: ignore[call-overload]
        except Exception as error:  # noqa: BLE001 - the thread's, looked at below
            failed.append(error)

    with caplog.at_level(logging.INFO, logger="octasplat"):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert failed == [] and (tmp_path / "a.png").is_file()
    assert any(line.startswith("Rendered 1 image") for line in caplog.messages)
    assert capfd.readouterr() == ("", "")


def test_notebook_shows_progress_and_ends_with_lines() -> None:
    from IPython.core.interactiveshell import InteractiveShell
    from IPython.utils.capture import capture_output

    from octasplat.engine.core.events import PhaseProgress, PhaseStarted, Warned
    from octasplat.notebook import NotebookProgress, ProgressLog, default_progress

    assert isinstance(default_progress(), ProgressLog)
    shell = InteractiveShell.instance()
    try:
        shell.kernel = object()
        listener = default_progress()
        assert isinstance(listener, NotebookProgress)
        events: list[Event] = [
            PhaseStarted("render", 4), PhaseProgress("render", 1, 4), Warned("a < b"),
            PhaseFinished("render", 2.0),
        ]  # fmt: skip
        with capture_output() as captured:
            for event in events:
                listener(event)
    finally:
        InteractiveShell.clear_instance()
    shown = [output.data["text/html"] for output in captured.outputs]
    assert "Rendering" in shown[0]
    assert any('<progress value="0.2500" max="1">' in text and "a &lt; b" in text for text in shown)
    assert "Rendered" in shown[-1] and "<progress" not in shown[-1]


def test_run_images_match_operation_result(finished_run: Path, tmp_path: Path) -> None:
    found = osp.render(osp.Run(finished_run), tmp_path / "views", views="held-out")
    assert found.images == 2 and all(path.is_file() for path in found.files)
    with pytest.raises(TypeError, match="goes with one camera"):
        osp.render(osp.load(finished_run), tmp_path / "views")  # type: ignore[call-overload]


def test_scene_of_run_is_traced_as_the_run_was(finished_run: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(finished_run, tmp_path / "run"))
    content = json.loads((run / "config.json").read_text())
    content["reconstruction"]["train"]["trace"] |= {"q": 4.0, "transmittance_min": 0.3}
    (run / "config.json").write_text(json.dumps(content))
    scene = osp.load(run)
    camera = scene.camera(width_px=48, height_px=36, fov_y_degrees=50.0)
    pose = {"camera_to_world": camera.world_from_cam.tolist(), "fov_y_degrees": 50.0}
    path = {"width": 48, "height": 36, "frames": [pose]}
    osp.render(run, tmp_path / "shown.exr", camera_path=path, background="black")
    shown = read_image(tmp_path / "shown.exr")
    image = osp.render(scene, camera)
    np.testing.assert_allclose(image.alpha, shown[..., 3], atol=1e-5)
    for of_run in (scene, scene.copy(), osp.GaussianTensors.of(scene, requires_grad=False)):
        traced = osp.trace(of_run, camera).alpha.numpy().reshape(36, 48)
        np.testing.assert_allclose(traced, shown[..., 3], atol=1e-5)
    of_file = osp.render(osp.load(run / "scene.ply"), camera)
    assert np.abs(of_file.alpha - image.alpha).max() > 0.01  # a file does not say


def test_viewer_of_run_has_cameras(finished_run: Path) -> None:
    import urllib.request

    with (
        osp.view(finished_run, open_browser=False) as viewer,
        urllib.request.urlopen(f"{viewer.url}cameras.json", timeout=10) as answer,
    ):
        cameras = json.load(answer)
    assert len(cameras["views"]) == 9
    assert [view["name"] for view in cameras["views"] if view["held_out"]] == ["view_000.png", "view_008.png"]
    fov = cameras["views"][0]["fov_y_degrees"]
    centre = osp.Camera.looking_at((0, 0, -1), (0, 0, 0), 48, 36, fov_y_degrees=fov)
    assert np.isfinite(centre.fy_px) and 10 < fov < 120


def test_resume_ignores_empty_settings(photographs: Path, finished_run: Path) -> None:
    run = osp.reconstruct(photographs, finished_run, resume=True, train={}, set=[])
    assert run.is_finished


def test_scene_of_a_run_is_seen_as_its_photographs_and_the_command_show_it(
    finished_run: Path, tmp_path: Path
) -> None:
    options = {"mode": "turntable", "frames": 2, "width_px": 48, "height_px": 36}
    osp.render(finished_run, tmp_path / "frames", **options)
    scene = osp.load(finished_run)
    cameras = scene.select(slice(None)).copy().turntable(2, 48, 36)
    for camera, frame in zip(cameras, sorted((tmp_path / "frames").rglob("*.png")), strict=True):
        np.testing.assert_allclose(osp.render(scene, camera).rgb, read_image(frame)[..., :3], atol=0.6 / 255)
    # The still life has z up, and a scene of COLMAP would have -y.
    assert -scene.camera().rotation_cam_from_world[1] @ (0, 0, 1) > 0.8


def test_scene_is_rendered_from_where_a_photograph_was_taken(finished_run: Path) -> None:
    run = osp.Run(finished_run)
    assert len(run.cameras) == 9
    seen = osp.render(run.scene, run.cameras["view_008.png"]).rgb
    stored = read_image(finished_run / "renders" / "view_008.png")[..., :3]
    np.testing.assert_allclose(seen, stored, atol=0.6 / 255)


def test_edited_run_is_finished_and_not_measured(in_folder: Path) -> None:
    osp.crop("run", "half", where="z < 0")
    half = osp.Run("half")
    assert half.is_finished and half.psnr is None and repr(half) == "Run('half', not measured)"
    assert osp.evaluate(half).psnr == half.psnr


def test_scene_of_an_unfinished_run_is_refused_with_what_to_do(photographs: Path, tmp_path: Path) -> None:
    with pytest.raises(osp.CancelledError):
        osp.reconstruct(photographs, tmp_path / "run", **RUN_OPTIONS, should_stop=lambda: True)
    run = osp.Run(tmp_path / "run")
    told = r"holds no scene\.ply yet; finish the run with"
    with pytest.raises(osp.OctasplatError, match=told):
        _ = run.scene
    with pytest.raises(osp.OctasplatError, match=told):
        osp.crop(run, tmp_path / "a.ply", where="z < 0")
