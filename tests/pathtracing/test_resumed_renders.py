"""Renders that were killed or stopped go on from the images that are done, and end with the same bytes."""

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.workers.cli.main import cli
from tests.support.daily import some_daily
from tests.support.light_scenes import table_with_a_box

STAGE = """
[[meshes]]
file = "thing.obj"
position = [0.5, -0.2, 0.5]
material = { kind = "mirror" }
[[lights]]
kind = "directional"
direction = [0.3, 1, 0.2]
irradiance = 2
[integrator]
samples = 48
"""
SMALL = ("--turntable", "--frames", 8, "--width", 32, "--height", 24, "--threads", 1)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene, and a stage that stands a mirror in it."""
    root = tmp_path_factory.mktemp("resumed")
    write_gaussian_ply(table_with_a_box(), root / "scene.ply")
    (root / "stage.toml").write_text(STAGE)
    (root / "thing.obj").write_text("v 0 0 0\nv .3 0 0\nv 0 -.3 0\nf 1 2 3\n")
    done = octasplat(folder=root, output="whole.mp4")
    assert done.exit_code == 0 and "Rendered 8 images" in done.output, done.output
    assert sorted(path.name for path in root.iterdir()) == [
        "scene.ply",
        "stage.toml",
        "thing.obj",
        "whole.mp4",
    ]
    return root


def arguments(folder: Path, output: str, *more: object) -> list[str]:
    given = (
        "render",
        folder / "scene.ply",
        "-o",
        folder / output,
        "--stage",
        folder / "stage.toml",
        *SMALL,
        *more,
    )
    return [str(argument) for argument in given]


def octasplat(*more: object, folder: Path, output: str) -> Result:
    return CliRunner().invoke(cli, arguments(folder, output, *more))


def stopped_by(
    number: signal.Signals, folder: Path, output: str, record: Path
) -> subprocess.CompletedProcess[str]:
    """A real process that gets a signal as soon as two images are done."""
    command = [sys.executable, "-m", "octasplat", *arguments(folder, output)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while process.poll() is None and not (record.exists() and len(record.read_text().splitlines()) > 2):
        time.sleep(0.005)
    process.send_signal(number)
    out, err = process.communicate(timeout=100)
    return subprocess.CompletedProcess(command, process.returncode, out, err)


@pytest.mark.exhaustive
def test_killed_render_resumes_frames(folder: Path) -> None:
    frames = folder / "turn.mp4.frames"
    killed = stopped_by(signal.SIGKILL, folder, "turn.mp4", frames / "unfinished.jsonl")
    assert killed.returncode == -signal.SIGKILL and not (folder / "turn.mp4").exists()
    kept = len((frames / "unfinished.jsonl").read_text().splitlines()) - 1
    assert 2 <= kept < 8
    # What was torn by the kill is not taken for whole, nor is a frame that somebody changed.
    with (frames / "unfinished.jsonl").open("a") as record:
        record.write('{"file": "0000')
    (frames / "000001.png").write_bytes(b"half a frame")
    refused = octasplat(folder=folder, output="turn.mp4")
    assert refused.exit_code == 1 and "add --resume" in refused.output
    done = octasplat("--resume", folder=folder, output="turn.mp4")
    assert done.exit_code == 0, done.output
    assert (folder / "turn.mp4").read_bytes() == (folder / "whole.mp4").read_bytes()
    assert not frames.exists()


@pytest.fixture(scope="module")
def stopped(folder: Path) -> subprocess.CompletedProcess[str]:
    """A render of images that got a Ctrl-C."""
    return stopped_by(signal.SIGINT, folder, "views", folder / "views" / "unfinished.jsonl")


@pytest.mark.exhaustive
@pytest.mark.parametrize("changed", some_daily(["stage.toml", "thing.obj", "scene.ply"], {"scene.ply"}))
def test_images_of_another_stage_are_not_mixed_in(
    folder: Path, stopped: subprocess.CompletedProcess[str], tmp_path: Path, changed: str
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    if changed == "scene.ply":
        write_gaussian_ply(table_with_a_box().select(slice(1, None)), tmp_path / changed)
    else:
        text = (tmp_path / changed).read_text()
        (tmp_path / changed).write_text(text.replace(".3", ".4").replace("0.2]", "0.25]"))
    before = sorted((tmp_path / "views").iterdir())
    refused = octasplat("--resume", folder=tmp_path, output="views")
    assert refused.exit_code == 1 and "images of another render" in refused.output
    assert sorted((tmp_path / "views").iterdir()) == before


def test_interrupted_render_resumes_from_complete_images(
    folder: Path, stopped: subprocess.CompletedProcess[str]
) -> None:
    views = folder / "views"
    assert stopped.returncode == 130 and "--resume goes on" in stopped.stderr, stopped
    listed = [json.loads(line)["file"] for line in (views / "unfinished.jsonl").read_text().splitlines()[1:]]
    assert sorted([*listed, "unfinished.jsonl"]) == sorted(path.name for path in views.iterdir())
    before = {name: (views / name).stat().st_mtime_ns for name in listed}
    done = octasplat("--resume", folder=folder, output="views")
    assert done.exit_code == 0, done.output
    assert {name: (views / name).stat().st_mtime_ns for name in listed} == before
    assert sorted(path.name for path in views.iterdir()) == [f"frame_{number:04d}.png" for number in range(8)]
