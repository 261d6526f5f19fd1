"""``octasplat demo``, made tiny."""

import json
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


def make_tiny(monkeypatch):
    """Let the demo take seconds."""
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


@pytest.fixture
def tiny_demo(monkeypatch):
    make_tiny(monkeypatch)


@pytest.fixture(scope="module")
def first_demo(octasplat, tmp_path_factory):
    """The folder of a finished demo, and what the command printed."""
    folder = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as monkeypatch:
        make_tiny(monkeypatch)
        opened = []
        monkeypatch.setattr(webbrowser, "open", opened.append)
        result = octasplat("demo", "-o", folder, *SIZE)
    assert result.exit_code == 0, result.output
    assert opened == [], "opened without a terminal"
    return folder, result.stdout


def test_demo_scene_only_writes_dataset_only(octasplat, tmp_path):
    result = octasplat("demo", "-o", tmp_path / "still", "--dataset-only", *SIZE)
    assert result.exit_code == 0, result.output
    assert len(list((tmp_path / "still" / "images").iterdir())) == 4
    assert str(tmp_path / "still") in result.stdout


@pytest.mark.exhaustive
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
    assert subprocess.run(command, cwd=ROOT, check=False, timeout=600).returncode == 143
    assert list(tmp_path.iterdir()) == []


def test_demo_is_generated_once_and_names_report(octasplat, first_demo, tiny_demo, monkeypatch):
    folder, told = first_demo
    report = folder / "result" / "report.html"
    assert report.exists()
    assert str(report) in told.splitlines()[-1]

    opened = []
    monkeypatch.setattr(webbrowser, "open", opened.append)
    second = octasplat("demo", "-o", folder, *SIZE, "--open")
    assert second.exit_code == 0, second.output
    assert second.stdout.splitlines() == told.splitlines()[-1:]
    assert opened == [report.as_uri()]


def test_finished_demo_is_json_again(octasplat, first_demo, tiny_demo):
    folder, _ = first_demo
    again = octasplat("demo", "-o", folder, *SIZE, "--json")
    assert again.exit_code == 0, again.output
    assert json.loads(again.stdout)["report"] == str(folder / "result" / "report.html")


def test_demo_resumes_automatically(octasplat, first_demo, tiny_demo):
    folder, _ = first_demo
    for name in ("report.html", "viewer.glb"):
        (folder / "result" / name).unlink()
    again = octasplat("demo", "-o", folder, *SIZE)
    assert again.exit_code == 0, again.output
    assert "Training" not in again.stdout
    assert (folder / "result" / "viewer.glb").exists()


def test_demo_with_other_settings_is_refused(octasplat, first_demo, tiny_demo):
    folder, _ = first_demo
    other_size = octasplat("demo", "-o", folder, "--views", 5)
    assert other_size.exit_code == 1 and other_size.stderr.count("\n") == 1
    other_preset = octasplat("demo", "-o", folder, *SIZE, "--preset", "standard")
    assert other_preset.exit_code == 1 and "-o" in other_preset.stderr
