import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from octasplat.engine.files.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from octasplat.engine.gaussians.scene_metadata import SceneMetadata
from octasplat.engine.render.environment_files import write_environment
from octasplat.engine.runs.config import resolve_config
from octasplat.workers.cli.main import cli
from tests.support.tiny_dataset import make_tiny_dataset

ROOT = Path(__file__).resolve().parents[2]
TINY = (
    "--preset", "fast", "--iterations", "60", "--rays-per-batch", "256", "--max-gaussians", "600",
    "--set", "initial_points=300", "--set", "probe_rays=256", "--set", "ssim_patch_side=16",
    "--test-every", "4", "--threads", "1",
)  # fmt: skip
"""Settings of a run of a second."""
MESHES = "octagons.ply,octagons.obj,octagons.glb,viewer.glb"
"""What a run exports by itself, without the textured surface, which takes longer than all else."""
LIT_UP = [0.0, -0.8, 0.6]
"""Up of the learnt light of ``lit_run``."""

Octasplat = Callable[..., Result]


@dataclass(frozen=True)
class Run:
    """A finished run."""

    scene: Path
    output: Path
    stdout: str

    def metrics(self) -> dict:
        return json.loads((self.output / "metrics.json").read_text())


@pytest.fixture(scope="session")
def octasplat() -> Octasplat:
    """Runs the command line in this process."""

    def run(*arguments: object) -> Result:
        return CliRunner().invoke(cli, [str(argument) for argument in arguments])

    return run


@pytest.fixture(scope="session")
def start_octasplat() -> Callable[..., subprocess.Popen[str]]:
    """Starts the command line as a program."""

    # Where a shell started the tests in the background, programs would inherit that Ctrl-C is ignored.
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)

    def start(*arguments: object) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [
                sys.executable,
                "-c",
                "from octasplat.workers.cli.main import main; main()",
                *map(str, arguments),
            ],
            cwd=ROOT,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    return start


@pytest.fixture(scope="session")
def tiny() -> tuple[str, ...]:
    """Settings of a run of a second with one mesh; the textured surface takes longer than all else."""
    return (*TINY, "--exports", "mesh.ply")


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory)


@pytest.fixture(scope="session")
def run(scene: Path, octasplat: Octasplat, tmp_path_factory: pytest.TempPathFactory) -> Run:
    output = tmp_path_factory.mktemp("finished") / "run"
    result = octasplat("reconstruct", scene, "-o", output, *TINY, "--exports", MESHES)
    assert result.exit_code == 0, result.output
    return Run(scene, output, result.stdout)


@pytest.fixture(scope="session")
def shiny_run(run, tmp_path_factory) -> Path:
    """The run of the other tests, with materials given to its Gaussians by hand."""
    root = tmp_path_factory.mktemp("shiny")
    shutil.copytree(run.output, root / "run")
    gaussians, _ = read_gaussian_ply(run.output / "scene.ply")
    count = len(gaussians)
    channels = {
        "albedo": np.full((count, 3), 0.25, np.float32),
        "metallic": np.full((count, 1), 1.0, np.float32),
        "roughness": np.full((count, 1), 0.5, np.float32),
    }
    given = resolve_config("fast", settings={"test_every": 4}, assignments=["materials.learn=true"])
    write_gaussian_ply(
        gaussians.with_channels(channels),
        root / "run" / "scene.ply",
        facts=SceneMetadata(turned_beyond=given.train.trace.flip_normal_cos),
    )
    for name in ("environment.exr", "environment.hdr"):
        write_environment(root / "run" / name, np.full((16, 32, 3), 0.5, np.float32))
    content = json.loads((root / "run" / "config.json").read_text())
    content["reconstruction"] = given.model_dump(mode="json")
    (root / "run" / "config.json").write_text(json.dumps(content))
    return root / "run"


@pytest.fixture(scope="session")
def lit_run(shiny_run, tmp_path_factory) -> Path:
    """A run with materials whose light differs all around, with an up of its own."""
    run = tmp_path_factory.mktemp("lit") / "run"
    shutil.copytree(shiny_run, run)
    light = np.full((16, 32, 3), 0.05, np.float32)
    light[:, :16, 0], light[:8, :, 1], light[:, 8:24, 2] = 0.6, 0.4, 0.5
    for name in ("environment.exr", "environment.hdr"):
        write_environment(run / name, light)
    config = json.loads((run / "config.json").read_text())
    config["reconstruction"]["train"]["materials"]["up_world"] = LIT_UP
    (run / "config.json").write_text(json.dumps(config))
    return run
