"""The file of residual colors: what is read back, and what does not belong to a scene."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.runs.residual_file import read_residual, write_residual


def scene(count: int) -> FlatGaussians:
    return FlatGaussians(
        np.zeros((count, 3), np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.zeros((count, 2), np.float32),
        np.zeros(count, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
def test_is_read_back_row_by_row(tmp_path: Path, coefficients: int) -> None:
    given = np.random.default_rng(0).normal(size=(5, coefficients, 3)).astype(np.float32)
    write_residual(tmp_path, np.asfortranarray(given))
    found = read_residual(tmp_path, scene(5))
    assert found is not None and found.flags.c_contiguous  # as kernels take it
    np.testing.assert_array_equal(found, given)


@pytest.mark.parametrize(
    "shape", [(5, 0, 3), (5, 2, 3), (5, 5, 3), (5, 25, 3), (4, 4, 3), (5, 4, 2), (5, 12)]
)
def test_other_shapes_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.savez(tmp_path / "residual.npz", sh=np.zeros(shape, np.float32))
    with pytest.raises(ConfigError, match="does not belong to the scene"):
        read_residual(tmp_path, scene(5))
