"""``octasplat reconstruct`` on photographs alone."""

import json
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from octasplat.engine.render.image_files import write_png
from tests.support.neighbouring_photographs import write_neighbours

pytestmark = pytest.mark.heavy


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Seven photographs of one thing, neighbours on a ring, and one of noise."""
    folder = tmp_path_factory.mktemp("bare") / "photographs"
    write_neighbours(folder, 7)
    noise = np.random.default_rng(5).random((360, 480, 3)).astype(np.float32)
    write_png(folder / "zz_noise.png", noise)
    return folder


def test_reconstruct_without_poses_names_alternatives(photographs, octasplat, tmp_path, tiny):
    output = tmp_path / "out"
    refused = octasplat("reconstruct", photographs, "-o", output, "--poses", "given", *tiny)
    assert refused.exit_code == 1 and not output.exists()
    assert "--poses auto" in refused.stderr and "octasplat submit" in refused.stderr
    scene = tmp_path / "scene"
    scene.mkdir()
    (scene / "images").symlink_to(photographs)
    refused = octasplat("reconstruct", scene, "-o", output, "--poses", "given", *tiny)
    assert refused.exit_code == 1 and not output.exists()
    assert "--poses auto" in refused.stderr and "octasplat submit" in refused.stderr


@pytest.mark.exhaustive
def test_poses_are_found_in_the_run_and_the_same_on_any_threads(photographs, octasplat, tmp_path, tiny):
    runs = [tmp_path / "one", tmp_path / "two"]
    for threads, output in enumerate(runs, start=1):
        done = octasplat(
            "reconstruct", photographs, "-o", output, "--max-side", "64", *tiny,
            "--threads", threads,
        )  # fmt: skip
        assert done.exit_code == 0, done.stderr
        assert "Found the poses of 7 of 8 photographs" in done.stdout
        assert "Poses found for 7 of 8 photographs" in done.stdout
        assert "1 of 8 photographs could not be placed" in done.stderr
    metrics = json.loads((runs[0] / "metrics.json").read_text())
    assert metrics["poses"] == {"placed": 7, "photographs": 8}
    for name in ("scene.ply", "poses/cameras.bin", "poses/images.bin", "poses/points3D.bin"):
        assert (runs[0] / name).read_bytes() == (runs[1] / name).read_bytes(), name
    events = [json.loads(line) for line in (runs[0] / "events.jsonl").read_text().splitlines()]
    finished = [event["stage"] for event in events if event["kind"] == "stage_finished"]
    assert finished[:4] == ["read", "features", "matches", "poses"] and finished[-4] == "load"
    again = octasplat("reconstruct", photographs, "-o", runs[0], "--resume")
    assert again.exit_code == 0 and "features" not in again.stdout
    views = octasplat("render", runs[0], "-o", tmp_path / "views", "--views", "held-out")
    assert views.exit_code == 0, views.stderr
    assert octasplat("evaluate", runs[0]).exit_code == 0


@pytest.mark.exhaustive
def test_killed_run_leaves_no_colmap_files(photographs, start_octasplat, tmp_path, tiny):
    process = start_octasplat("reconstruct", photographs, "-o", tmp_path / "out", "--poses", "auto", *tiny)
    until = time.monotonic() + 60
    while not (children := psutil.Process(process.pid).children()) and time.monotonic() < until:
        time.sleep(0.05)
    process.kill()
    process.communicate()
    assert children
    _, alive = psutil.wait_procs(children, timeout=30)
    assert not alive
