"""Files that find no room: a sentence that names them, and everything before them whole.

A limit on the size of a file stands for the full disk; the system tells of both when bytes are written.
"""

import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.small_disk import files_no_larger_than

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def copy(run, tmp_path: Path) -> Callable[..., Path]:
    """The finished run without some of its files, which resuming makes again."""

    def make(*missing: str) -> Path:
        output = tmp_path / "run"
        shutil.copytree(run.output, output)
        for name in missing:
            path = output / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        return output

    return make


LATER = ("metrics.json", "report.html", "viewer.glb", "octagons.ply", "octagons.obj", "octagons.glb")


@pytest.mark.parametrize(
    ("missing", "named", "limit_bytes"),
    [
        (("cache",), "cache/rgb.bin", 30_000),
        (("checkpoints", "scene.ply", *LATER), "checkpoints/iteration_0000000.npz", 30_000),
        (("scene.ply", *LATER), "scene.ply", 20_000),
        pytest.param(("report.html",), "report.html", 40_000, marks=pytest.mark.exhaustive),
        pytest.param(("octagons.obj",), "octagons.obj", 40_000, marks=pytest.mark.exhaustive),
        pytest.param(("octagons.glb",), "octagons.glb", 40_000, marks=pytest.mark.exhaustive),
    ],
)
def test_full_disk_error_names_file_and_run_resumes(copy, run, octasplat, missing, named, limit_bytes):
    output = copy(*missing)
    with files_no_larger_than(limit_bytes):
        result = octasplat("reconstruct", run.scene, "-o", output, "--resume", "--threads", 1)
    assert result.exit_code == 1, result.output
    assert result.stderr.count("\n") == 1
    assert f"{output / named} cannot be written" in result.stderr
    assert "free space" in result.stderr and "--resume" in result.stderr
    assert "unexpected" not in result.stderr
    assert not [path for path in output.rglob("*") if ".partial" in path.name]
    assert not (output / named).exists()
    result = octasplat("reconstruct", run.scene, "-o", output, "--resume", "--threads", 1)
    assert result.exit_code == 0, result.output
    assert (output / "scene.ply").read_bytes() == (run.output / "scene.ply").read_bytes()


def test_full_disk_while_writing_events_is_reported(copy, run, octasplat):
    output = copy()
    events = output / "events.jsonl"
    with files_no_larger_than(events.stat().st_size):
        result = octasplat("reconstruct", run.scene, "-o", output, "--resume", "--threads", 1)
    assert result.exit_code == 1
    assert f"{events} cannot be written" in result.stderr and result.stderr.count("\n") == 1


def test_full_disk_while_writing_depth_maps_is_reported(run, octasplat, tmp_path):
    with files_no_larger_than(10_000):
        result = octasplat("surface", run.output, "-o", tmp_path / "surface.glb", "--threads", 1)
    assert result.exit_code == 1
    assert f"{tmp_path} cannot be written" in result.stderr and result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.exhaustive
def test_command_on_full_disk_prints_one_error(copy, run):
    output = copy("checkpoints", "scene.ply", *LATER)

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (30_000, 30_000))

    done = subprocess.run(
        [sys.executable, "-c", "from octasplat.workers.cli.main import main; main()",
         "reconstruct", str(run.scene), "-o", str(output), "--resume", "--threads", "1", "--quiet"],
        cwd=ROOT, preexec_fn=limit, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.startswith(f"Error: {output / 'checkpoints/iteration_0000000.npz'} cannot be written")
    assert done.stderr.count("\n") == 1
