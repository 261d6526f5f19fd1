"""The main job by its command: what it leaves, what it says, how it stops and goes on."""

import json
import os
import pty
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from tests.support.daily import some_daily

FILES = (
    "scene.ply", "viewer.glb", "octagons.ply", "octagons.obj", "octagons.glb", "metrics.json", "report.html",
    "config.json",
    "events.jsonl", "held_out.json",
)  # fmt: skip


def events(output):
    return [json.loads(line) for line in (output / "events.jsonl").read_text().splitlines()]


def test_reconstruct_writes_all_files(run):
    for name in FILES:
        assert (run.output / name).stat().st_size > 0, name
    assert list((run.output / "checkpoints").glob("*.npz"))
    held_out = json.loads((run.output / "held_out.json").read_text())
    assert held_out == ["view_000.png", "view_004.png"]
    assert sorted(path.name for path in (run.output / "renders").iterdir()) == held_out


def test_metrics_file_has_documented_keys(run):
    metrics = run.metrics()
    assert {"psnr", "ssim", "ms_ssim", "flip"} <= set(metrics["mean"])
    assert metrics["mean"]["psnr"] > 5
    assert metrics["iterations"] == 60
    assert set(metrics["views"]) == {"view_000.png", "view_004.png"}


def test_settings_reach_the_run(run):
    config = json.loads((run.output / "config.json").read_text())["reconstruction"]
    assert config["preset"] == "fast"
    assert config["test_every"] == 4
    assert config["train"]["rays_per_batch"] == 256
    assert config["train"]["initial_points"] == 300


def test_plain_output_has_no_control_characters_and_names_the_results(run):
    assert not re.search(r"[\x00-\x09\x0b-\x1f\x7f\x80-\x9f]", run.stdout)
    assert f"PSNR {run.metrics()['mean']['psnr']:.2f} dB" in run.stdout
    assert str(run.output / "report.html") in run.stdout
    assert str(run.output / "viewer.glb") in run.stdout
    assert "Trained 60 iterations" in run.stdout
    assert "rays/s" in run.stdout


def test_training_time_is_reported_once(run):
    (finished,) = [e for e in events(run.output) if e["kind"] == "stage_finished" and e["stage"] == "train"]
    training = json.loads((run.output / "training.json").read_text())
    assert finished["seconds"] == training["seconds"] == run.metrics()["seconds"]
    told = re.findall(r"[Tt]rained (?:60 iterations )?in (\S+ (?:s|min))", run.stdout)
    assert len(told) == 2 and len(set(told)) == 1, run.stdout


def test_reconstruct_writes_refined_poses_on_request(run, octasplat, tiny, tmp_path):
    assert "poses" not in json.loads((run.output / "training.json").read_text())
    output = tmp_path / "run"
    asked = ("--set", "refine_poses=true", "--exports", "")
    result = octasplat("reconstruct", run.scene, "-o", output, *tiny, *asked)
    assert result.exit_code == 0, result.output
    poses = json.loads((output / "training.json").read_text())["poses"]
    given = {view["name"]: view for view in json.loads((output / "views.json").read_text())["views"]}
    trained = given.keys() - set(json.loads((output / "held_out.json").read_text()))
    assert poses and poses.keys() <= trained
    largest = max(poses, key=lambda name: poses[name]["moved_px"])
    assert (
        f"The poses of {len(poses)} of {len(trained)} training views were corrected" in result.output
        and f"{poses[largest]['moved_px']:.2f} px at most ({largest})" in result.output
    )
    for name, pose in poses.items():
        turned = (
            np.array(pose["rotation_cam_from_world"]) @ np.array(given[name]["rotation_cam_from_world"]).T
        )
        degrees = np.degrees(np.arccos((np.trace(turned) - 1) / 2))
        assert 0 < degrees < 3 and abs(degrees - pose["turned_deg"]) < 1e-3


def test_resume_of_a_finished_run_needs_no_settings(run, octasplat):
    before = (run.output / "scene.ply").read_bytes()
    result = octasplat("reconstruct", run.scene, "-o", run.output, "--resume", "--threads", 1)
    assert result.exit_code == 0, result.output
    assert (run.output / "scene.ply").read_bytes() == before


def test_resume_with_other_settings_is_refused(run, octasplat):
    result = octasplat("reconstruct", run.scene, "-o", run.output, "--resume", "--iterations", 61)
    assert result.exit_code == 1
    assert "settings" in result.stderr


def test_resume_without_run_starts_and_quiet_prints_nothing(scene, octasplat, tiny, tmp_path):
    result = octasplat(
        "reconstruct", scene, "-o", tmp_path / "run", "--resume", "--quiet", *tiny,
        "--iterations", 3, "--held-out", "view_001.png", "--held-out", "view_002.png",
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert result.output == ""
    assert json.loads((tmp_path / "run" / "held_out.json").read_text()) == ["view_001.png", "view_002.png"]


@pytest.mark.parametrize(
    ("number", "code"),
    some_daily([(signal.SIGINT, 130), (signal.SIGTERM, 143)], {(signal.SIGINT, 130)}),
)
def test_signal_writes_checkpoint_and_resume_completes(
    scene, start_octasplat, octasplat, tiny, tmp_path, number, code
):
    output = tmp_path / "run"
    long = [*tiny, "--iterations", 600]
    process = start_octasplat("reconstruct", scene, "-o", output, *long)
    wait_for(lambda: any(e["kind"] == "training_progress" for e in events(output)), process)
    process.send_signal(number)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == code, stderr
    assert re.fullmatch(r"Estimate: .*\nStopped after iteration \d+ of 600; .*--resume.*\n", stderr)
    stopped_at = int(stderr.splitlines()[-1].split()[3])
    assert (output / "checkpoints" / f"iteration_{stopped_at:07d}.npz").exists()
    assert not (output / "scene.ply").exists()

    if number == signal.SIGTERM:
        return  # the rest is the same
    result = octasplat("reconstruct", scene, "-o", output, "--resume", "--threads", 1)
    assert result.exit_code == 0, result.output
    progress = [e for e in events(output) if e["kind"] == "training_progress"]
    steps = [e["iteration"] for e in progress]
    assert steps == sorted(set(steps)), "iterations were done twice"
    metrics = json.loads((output / "metrics.json").read_text())
    assert metrics["iterations"] == 600
    (finished,) = [e for e in events(output) if e["kind"] == "stage_finished" and e["stage"] == "train"]
    before = max(e["seconds"] for e in progress if e["iteration"] <= stopped_at)
    assert finished["seconds"] == metrics["seconds"] > before > 0, "the time before the stop counts too"


def test_signal_during_evaluation_stops_run(run, octasplat, monkeypatch):
    (run.output / "report.html").unlink()

    def interrupt(*_arguments):
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("octasplat.engine.evaluate.held_out.write_png", interrupt)
    result = octasplat("reconstruct", run.scene, "-o", run.output, "--resume", "--threads", 1)
    assert result.exit_code == 130
    assert "evaluating" in result.stderr
    monkeypatch.undo()
    assert octasplat("reconstruct", run.scene, "-o", run.output, "--resume", "--threads", 1).exit_code == 0
    assert (run.output / "report.html").exists()


@pytest.mark.exhaustive
def test_terminal_output_has_progress_bar(scene, tiny, tmp_path):
    master, slave = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", "from octasplat.workers.cli.main import main; main()",
         "reconstruct", str(scene), "-o", str(tmp_path / "run"), *tiny],
        stdout=slave, stderr=slave, cwd=Path(__file__).parents[2],
        env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "100"},
    )  # fmt: skip
    os.close(slave)
    shown = b""
    while True:
        try:
            block = os.read(master, 65536)
        except OSError:
            break
        if not block:
            break
        shown += block
    os.close(master)
    text = shown.decode()
    assert process.wait(60) == 0, text
    assert "\x1b[2K" in text, "no bar was drawn"
    assert "Trained 60 iterations" in text
    assert text.count("\x1b[?25h") >= text.count("\x1b[?25l") > 0, "the cursor stays hidden"


def wait_for(condition, process, seconds=60):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            if condition():
                return
        except (OSError, ValueError):
            pass
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    process.kill()
    raise AssertionError("nothing happened in time")
