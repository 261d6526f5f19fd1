"""A generated scene to write positions into."""

import shutil
from pathlib import Path

import pytest

from tests.support.tiny_dataset import make_tiny_dataset


@pytest.fixture(scope="session")
def unplaced(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory, views=12, width_px=320, height_px=240, points=50)


@pytest.fixture
def scene(unplaced: Path, tmp_path: Path) -> Path:
    """A copy of its own for each test."""
    return Path(shutil.copytree(unplaced, tmp_path / "scene"))
