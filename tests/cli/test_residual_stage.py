"""The stage of a training with materials that fits residual colors: progress, stops, kills and resumes."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

import octasplat as osp
from octasplat.engine.core.events import PhaseProgress, PhaseStarted, TrainingProgress
from tests.cli.test_materials_run import MATERIALS

LONG_FIT = (*MATERIALS, "--set", "materials.residual_share=10")


def rows(output):
    return [json.loads(line) for line in (output / "events.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def whole(scene, octasplat, tiny, tmp_path_factory):
    output = tmp_path_factory.mktemp("whole") / "run"
    result = octasplat("reconstruct", scene, "-o", output, *tiny, *LONG_FIT)
    assert result.exit_code == 0, result.output
    return output, result.output


def test_fit_is_a_stage_with_progress_and_time(whole):
    output, told = whole
    assert "Fitting residual colors" in told and "Fitted residual colors in" in told
    found = rows(output)
    finished = {row["stage"]: row["seconds"] for row in found if row["kind"] == "stage_finished"}
    assert list(finished) == ["load", "train", "residual", "evaluate", "export"]
    steps = [row["step"] for row in found if row["kind"] == "stage_progress" and row["stage"] == "residual"]
    assert steps[0] == 0 and steps == sorted(steps)
    # the views are measured with what was fitted
    views = len(json.loads((output / "views.json").read_text())["views"])
    assert 600 in steps and steps[-1] == 600 + views
    [started] = [row for row in found if row["kind"] == "stage_started" and row["stage"] == "residual"]
    assert started["total_steps"] == 600 + views
    record = json.loads((output / "training.json").read_text())
    assert record["seconds"] == pytest.approx(finished["train"] + finished["residual"], abs=1)
    assert ">residual <" in (output / "report.html").read_text()


def test_time_left_of_training_holds_the_fit(whole):
    for row in rows(whole[0]):
        if row["kind"] == "training_progress":
            assert 0 < row["seconds_after"] <= row["seconds_left"]


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_run_that_ends_in_the_fit_resumes_to_the_same_bytes(how, whole, scene, octasplat, tiny, tmp_path):
    output = tmp_path / "run"
    command = ("reconstruct", scene, "-o", output, *tiny, *LONG_FIT)
    program = "import time\nfrom octasplat.engine.train.loop import residual_fit as fit\n"
    program += "old = fit.pixel_loss\n"  # slowed, so that it ends in the middle of the fit
    program += "def slow(*a, **k):\n    time.sleep(0.05)\n    return old(*a, **k)\nfit.pixel_loss = slow\n"
    program += "from octasplat.workers.cli.main import main; main()"
    running = subprocess.Popen(
        [sys.executable, "-c", program, *map(str, command)],
        env={**os.environ, "OMP_NUM_THREADS": "1"}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    told, deadline = output / "events.jsonl", time.monotonic() + 300
    while time.monotonic() < deadline and running.poll() is None:
        if told.exists() and '"stage": "residual", "step": 1' in told.read_text():
            break
        time.sleep(0.02)
    running.send_signal(how)
    _, errors = running.communicate(timeout=120)
    assert running.returncode != 0
    fitted = [row for row in rows(output) if row["kind"] == "stage_progress" and row["stage"] == "residual"]
    assert fitted[-1]["step"] < 500
    if how == signal.SIGINT:
        assert "while fitting residual colors" in " ".join(errors.split())
    assert not (output / "scene.ply").exists()
    result = octasplat(*command, "--resume")
    assert result.exit_code == 0, result.output
    for name in ("scene.ply", "environment.exr", "residual.npz"):
        assert (output / name).read_bytes() == (whole[0] / name).read_bytes(), name


def test_callback_is_called_and_stops_in_the_fit(scene, tmp_path):
    train = {
        "iterations": 60, "rays_per_batch": 256, "max_gaussians": 600, "initial_points": 300,
        "probe_rays": 256,
        "materials": {"environment_height": 16, "ambient_occlusion_rays": 4, "residual_share": 10},
    }  # fmt: skip
    stages, called = [], []

    def listen(event):
        if isinstance(event, PhaseStarted | PhaseProgress):
            stages.append(event.stage)

    def on_step(event):
        assert isinstance(event, TrainingProgress)
        called.append(event)
        return stages[-1] != "residual"

    run = osp.reconstruct(
        scene, tmp_path / "run", preset="fast", materials=True, train=train, exports=(), threads=1,
        on_step=on_step, progress=listen,
    )  # fmt: skip
    assert not run.is_finished and stages[-1] == "residual"
    assert called[-1].iteration == 60 and called[-1].seconds_left == called[-1].seconds_after > 0
    stages.clear()
    called.clear()  # the training is done, so that it tells nothing any more
    run = osp.reconstruct(scene, run, resume=True, threads=1, on_step=on_step, progress=listen)
    assert not run.is_finished and stages[-1] == "residual"
    assert called[-1].iteration == 60 and called[-1].seconds_left == called[-1].seconds_after > 0
