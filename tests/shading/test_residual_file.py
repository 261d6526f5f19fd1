"""The file of residual colors: what is read back, and what does not belong to a scene."""

from dataclasses import replace
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
    write_residual(tmp_path, scene(5), np.asfortranarray(given))
    found = read_residual(tmp_path, scene(5))
    assert found is not None and found.flags.c_contiguous  # as kernels take it
    np.testing.assert_array_equal(found, given)


@pytest.mark.parametrize(
    "shape", [(5, 0, 3), (5, 2, 3), (5, 5, 3), (5, 25, 3), (4, 4, 3), (5, 4, 2), (5, 12), ()]
)
def test_other_shapes_are_refused(tmp_path: Path, shape: tuple[int, ...]) -> None:
    np.savez(tmp_path / "residual.npz", sh=np.zeros(shape, np.float32))
    with pytest.raises(ConfigError, match="does not belong to the scene"):
        read_residual(tmp_path, scene(5))
    with pytest.raises(ConfigError, match="does not belong to the scene"):
        read_residual(tmp_path, scene(5), np.array([True] * 5 + [False]))


def spread_scene(count: int) -> FlatGaussians:
    means = np.random.default_rng(1).normal(scale=30, size=(count, 3)).astype(np.float32)
    return replace(scene(count), means_world=means)


def test_rows_of_another_order_are_refused(tmp_path: Path) -> None:
    gaussians = spread_scene(6)
    write_residual(tmp_path, gaussians, np.zeros((6, 4, 3), np.float32))
    swapped = gaussians.select(np.array([0, 2, 1, 3, 4, 5]))
    with pytest.raises(ConfigError, match="does not belong to the scene"):
        read_residual(tmp_path, swapped)


def test_positions_rounded_as_text_are_accepted(tmp_path: Path) -> None:
    gaussians = spread_scene(6)
    write_residual(tmp_path, gaussians, np.zeros((6, 4, 3), np.float32))
    text = np.array([[f"{value:.6g}" for value in mean] for mean in gaussians.means_world], np.float32)
    assert (text != gaussians.means_world).any()
    assert read_residual(tmp_path, replace(gaussians, means_world=text)) is not None


def test_file_without_positions_is_accepted(tmp_path: Path) -> None:
    np.savez(tmp_path / "residual.npz", sh=np.zeros((6, 4, 3), np.float32))
    assert read_residual(tmp_path, spread_scene(6)) is not None


@pytest.mark.parametrize("means", [np.zeros((5, 3), np.float32), np.zeros((6, 2), np.float32), np.zeros(6)])
def test_positions_of_another_shape_are_refused(tmp_path: Path, means: np.ndarray) -> None:
    np.savez(tmp_path / "residual.npz", sh=np.zeros((6, 4, 3), np.float32), means=means)
    with pytest.raises(ConfigError, match="does not belong to the scene"):
        read_residual(tmp_path, spread_scene(6))


def test_rows_that_reading_left_out_are_left_out(tmp_path: Path) -> None:
    gaussians, kept = spread_scene(6), np.array([True, False, True, True, False, True])
    given = np.random.default_rng(0).normal(size=(6, 4, 3)).astype(np.float32)
    write_residual(tmp_path, gaussians, given)
    found = read_residual(tmp_path, gaussians.select(kept), kept)
    assert found is not None
    np.testing.assert_array_equal(found, given[kept])
    with pytest.raises(ConfigError, match="does not belong to the scene"):
        read_residual(tmp_path, gaussians.select(~kept), ~kept[:5])
