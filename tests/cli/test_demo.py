"""``octasplat demo``, made tiny."""

import signal
import subprocess
import sys
import time
import webbrowser
from pathlib import Path

import pytest

from octasplat.engine.runs import small_surface
from octasplat.workers.cli import demo_run

ROOT = Path(__file__).resolve().parents[2]
SIZE = ("--views", 4, "--width", 32, "--height", 24)


@pytest.fixture
def tiny_demo(monkeypatch):
    settings = (
        "iterations=3",
        "rays_per_batch=64",
        "initial_points=100",
        "probe_rays=256",
        "ssim_patch_side=16",
    )
    monkeypatch.setattr(demo_run, "DEMO_ASSIGNMENTS", {"fast": settings})
    coarse = small_surface.OPTIONS.model_copy(
        update={"resolution": 48, "depth_side": 64, "texture_size": 128}
    )
    monkeypatch.setattr(small_surface, "OPTIONS", coarse)


def test_demo_scene_only_writes_dataset_only(octasplat, tmp_path):
    result = octasplat("demo", "-o", tmp_path / "still", "--dataset-only", *SIZE)
    assert result.exit_code == 0, result.output
    assert len(list((tmp_path / "still" / "images").iterdir())) == 4
    assert str(tmp_path / "still") in result.stdout


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_demo_signal_leaves_no_partial_scene(start_octasplat, tmp_path, number, code):
    process = start_octasplat("demo", "-o", tmp_path / "still", "--dataset-only", "--views", 500)
    deadline = time.monotonic() + 240
    while not any(path.name.endswith(".partial") for path in tmp_path.iterdir()):
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.05)
    process.send_signal(number)
    _, stderr = process.communicate(timeout=240)
    assert process.returncode == code, stderr
    assert len(stderr.splitlines()) <= 1, stderr
    assert list(tmp_path.iterdir()) == []


STOPPED_AT_ONCE = """
import os, pathlib, signal, sys
from octasplat.workers.cli.demo_run import make_demo_scene

made = pathlib.Path.mkdir

def mkdir(path, *given, **named):
    made(path, *given, **named)
    if path.name.endswith(".partial"):
        os.kill(os.getpid(), signal.SIGTERM)

pathlib.Path.mkdir = mkdir
make_demo_scene(pathlib.Path(sys.argv[1]), {"views": 4}, quiet=True)
"""


def test_demo_signal_at_start_leaves_no_files(tmp_path):
    """As it happens on a loaded machine: right after the folder was made."""
    command = [sys.executable, "-c", STOPPED_AT_ONCE, str(tmp_path / "still")]
    assert subprocess.run(command, cwd=ROOT, check=False, timeout=120).returncode == 143
    assert list(tmp_path.iterdir()) == []


def test_demo_is_generated_once_and_names_report(octasplat, tmp_path, tiny_demo, monkeypatch):
    opened = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    first = octasplat("demo", "-o", tmp_path, *SIZE)
    assert first.exit_code == 0, first.output
    report = tmp_path / "result" / "report.html"
    assert report.exists()
    assert str(report) in first.stdout.splitlines()[-1]
    assert opened == [], "opened without a terminal"

    second = octasplat("demo", "-o", tmp_path, *SIZE, "--open")
    assert second.exit_code == 0, second.output
    assert second.stdout.splitlines() == first.stdout.splitlines()[-1:]
    assert opened == [report.as_uri()]


def test_demo_resumes_automatically(octasplat, tmp_path, tiny_demo):
    assert octasplat("demo", "-o", tmp_path, *SIZE).exit_code == 0
    for name in ("report.html", "viewer.glb"):
        (tmp_path / "result" / name).unlink()
    again = octasplat("demo", "-o", tmp_path, *SIZE)
    assert again.exit_code == 0, again.output
    assert "Training" not in again.stdout
    assert (tmp_path / "result" / "viewer.glb").exists()


def test_demo_with_other_settings_is_refused(octasplat, tmp_path, tiny_demo):
    assert octasplat("demo", "-o", tmp_path, *SIZE).exit_code == 0
    other_size = octasplat("demo", "-o", tmp_path, "--views", 5)
    assert other_size.exit_code == 1 and other_size.stderr.count("\n") == 1
    other_preset = octasplat("demo", "-o", tmp_path, *SIZE, "--preset", "standard")
    assert other_preset.exit_code == 1 and "-o" in other_preset.stderr
