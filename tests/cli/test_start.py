"""How a command starts: what it imports, and how often garbage is collected meanwhile."""

import gc
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.files.gaussian_ply import write_gaussian_ply
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.workers.cli.collector import rare_collections

SEES_PHOTOGRAPHS = ("octasplat.engine.dataset.dataset", "octasplat.engine.dataset.duplicates")
COMPILER = ("numba", "scipy")
RENDER = ("render", "--camera", "0", "0", "-5", "--width", "16", "--height", "16", "--threads", "1")


@pytest.mark.parametrize(
    ("arguments", "unwanted"),
    [
        (("info",), ("torch", "pycolmap", *COMPILER, *SEES_PHOTOGRAPHS)),
        (
            (*RENDER, "-o", "a.png"),
            ("torch", "pycolmap", "scipy.spatial", "octasplat.engine.train.loop", *SEES_PHOTOGRAPHS),
        ),
    ],
)
def test_commands_on_a_file_load_nothing_for_photographs(
    tmp_path: Path, arguments: tuple[str, ...], unwanted: tuple[str, ...]
) -> None:
    one = FlatGaussians(
        np.zeros((1, 3), np.float32), np.eye(1, 4, dtype=np.float32), np.zeros((1, 2), np.float32),
        np.zeros(1, np.float32), np.zeros((1, 1, 3), np.float32),
    )  # fmt: skip
    write_gaussian_ply(one, tmp_path / "one.ply")
    code = f"""
import sys
from octasplat.workers.cli.main import cli
try:
    cli({[*arguments, "one.ply"]!r})
except SystemExit as end:
    assert end.code == 0, end.code
found = set({unwanted!r}) & set(sys.modules)
assert not found, found
"""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_garbage_is_collected_as_usual_once_the_work_begins() -> None:
    usual = gc.get_threshold()
    with rare_collections() as end:
        assert gc.get_threshold()[0] > usual[0]
        end()
        assert gc.get_threshold() == usual
    with pytest.raises(ZeroDivisionError), rare_collections():
        1 / 0  # noqa: B018
    assert gc.get_threshold() == usual
