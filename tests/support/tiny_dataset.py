"""Generated photographs that take a second to make."""

from pathlib import Path
from typing import Any

import pytest

from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset


def make_tiny_dataset(factory: pytest.TempPathFactory, **changes: Any) -> Path:
    """A dataset in a folder of its own: 8 views of 64 x 48 pixels and 400 points, but for the changes."""
    root = factory.mktemp("generated") / "scene"
    config = {"views": 8, "width_px": 64, "height_px": 48, "samples_per_side": 1, "points": 400, **changes}
    write_synthetic_dataset(root, SyntheticDatasetConfig(**config))
    return root
