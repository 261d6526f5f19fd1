"""Which file of a run holds the light that it has learnt."""

from pathlib import Path

import numpy as np

from octasplat.engine.render.environment_files import read_environment, write_environment
from octasplat.engine.runs.run_folder import run_environment


def test_run_environment_prefers_exact_map(tmp_path: Path) -> None:
    light = np.full((8, 16, 3), (4.0, 0.03, 0.011), np.float32)
    write_environment(tmp_path / "environment.hdr", light)
    coarse = read_environment(run_environment(tmp_path))  # runs of old have no other
    assert np.abs(coarse / light - 1).max() > 0.3
    write_environment(tmp_path / "environment.exr", light)
    np.testing.assert_array_equal(read_environment(run_environment(tmp_path)), light)
