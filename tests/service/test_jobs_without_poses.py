"""Photographs without poses, over HTTP: structure from motion as the first stages of the job."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks.chaos_machine import ROOT, Machine
from octasplat.engine.render.image_files import write_png
from octasplat.workers.client.api import Api
from tests.support.neighbouring_photographs import write_neighbours

pytestmark = pytest.mark.heavy

FEW = (
    "--set", "iterations=60", "--set", "train.rays_per_batch=256", "--set", "train.max_gaussians=400",
    "--set", "train.initial_points=300", "--set", "train.probe_rays=256", "--set", "test_every=4",
)  # fmt: skip

Octasplat = Callable[..., "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def octasplat(machine: Machine) -> Octasplat:
    """Runs the command line as a program."""
    environment = {**os.environ, "OCTASPLAT_DATA": str(machine.data)}

    def run(*arguments: object) -> "subprocess.CompletedProcess[str]":
        command = [sys.executable, "-m", "octasplat", *map(str, arguments)]
        return subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300, check=False
        )

    return run


@pytest.fixture(scope="module")
def machine(short_root: Path) -> Iterator[Machine]:
    folder = short_root / "bare"
    folder.mkdir()
    machine = Machine(folder, slots=1)
    machine.start()
    yield machine
    machine.stop()


@pytest.mark.exhaustive
def test_reconstruct_folder_without_poses_succeeds(
    machine: Machine, octasplat: Octasplat, tmp_path: Path
) -> None:
    images = tmp_path / "photographs"
    write_neighbours(images, 8)
    result = tmp_path / "result"
    done = octasplat(
        "submit", images, "--wait", "-o", result, "--preset", "fast", *FEW, "--max-side", "96",
        "--server", machine.address,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr + done.stdout
    assert (result / "viewer.glb").exists() and (result / "poses" / "images.bin").exists()
    metrics = json.loads((result / "metrics.json").read_text())
    assert metrics["gaussians"] > 0 and metrics["poses"] == {"placed": 8, "photographs": 8}
    assert "Poses found for 8 of 8 photographs" in done.stdout
    for line in ("Found features 8 photographs", "Matched 28 pairs", "Found the poses of 8 of 8 photographs"):
        assert line in done.stdout
    with Api(machine.address, machine.token) as api:
        (listed,) = api.get("/v1/jobs")["jobs"]
        job = api.get(f"/v1/jobs/{listed['id']}")
        assert job["stages"] == [
            "read", "features", "matches", "poses", "load", "train", "evaluate", "export",
        ]  # fmt: skip
        assert job["options"]["poses"] == "auto" and job["state"] == "succeeded"
        events = api.get(f"/v1/jobs/{job['id']}/timeline", limit=5000)["events"]
        told = {e["data"]["stage"] for e in events if e["kind"] == "progress" and "total_steps" in e["data"]}
        assert {"features", "poses"} <= told
        finished = [e["data"]["stage"] for e in events if e["kind"] == "stage_finished"]
        assert finished == job["stages"]


@pytest.mark.exhaustive
def test_job_with_unrelated_photographs_fails_with_reason(
    machine: Machine, octasplat: Octasplat, tmp_path: Path
) -> None:
    images = tmp_path / "noise"
    rng = np.random.default_rng(3)
    for number in range(4):
        write_png(images / f"{number}.png", rng.random((96, 128, 3)).astype(np.float32))
    to = ("--server", machine.address)
    unknown = octasplat("submit", images, "--set", "train.raze=5", *to)
    assert unknown.returncode == 1 and "There is no setting 'raze'" in unknown.stderr
    done = octasplat("submit", images, "--wait", "-o", tmp_path / "no", *FEW, *to)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "do not overlap enough" in done.stderr and "send a COLMAP model" in done.stderr
    assert not (tmp_path / "no").exists()
    with Api(machine.address, machine.token) as api:
        job = api.get("/v1/jobs")["jobs"][0]
        assert (job["state"], job["attempt"], job["error"]["type"]) == ("failed", 1, "dataset_error")
