import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.workers.cli.main import cli

BLENDER = "OCTASPLAT_BPY_PYTHON"


@pytest.fixture
def make_scene() -> Callable[..., FlatGaussians]:
    def make(
        count: int, sh_degree: int = 3, seed: int = 0, size: float = 0.06, spread: float = 1.0
    ) -> FlatGaussians:
        random = np.random.default_rng(seed)

        def normal(*shape: int) -> np.ndarray:
            return random.standard_normal(shape, dtype=np.float32)

        return FlatGaussians(
            means_world=random.uniform(-spread, spread, (count, 3)).astype(np.float32),
            quats_wxyz=normal(count, 4) * 3,
            log_scales=0.4 * normal(count, 2) + np.float32(np.log(size)),
            opacity_logits=normal(count) + 2,
            sh=normal(count, (sh_degree + 1) ** 2, 3),
        )

    return make


@pytest.fixture(scope="session")
def octasplat() -> Callable[..., Result]:
    """Runs the command line in this process."""

    def run(*arguments: object) -> Result:
        return CliRunner().invoke(cli, [str(argument) for argument in arguments])

    return run


@pytest.fixture(scope="session")
def blender() -> Callable[[Path, Path, str], None]:
    """Imports a mesh into Blender, edits it and exports it."""
    python = os.environ.get(BLENDER)
    if not python:
        pytest.skip(f"{BLENDER} does not name a Python interpreter with Blender's module bpy")

    def run(source: Path, target: Path, edit: str) -> None:
        script = Path(__file__).with_name("blender_edit.py")
        done = subprocess.run(
            [python, str(script), str(source), str(target), edit],
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == 0 and target.exists(), done.stdout + done.stderr

    return run
