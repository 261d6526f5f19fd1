"""Which scenes have materials, and what their numbers mean."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.gaussians.materials import (
    has_materials,
    reflective_fraction,
    require_materials,
)
from octasplat.engine.gaussians.model import FlatGaussians


def plain(count: int) -> FlatGaussians:
    return FlatGaussians(
        np.zeros((count, 3), np.float32),
        np.ones((count, 4), np.float32),
        np.zeros((count, 2), np.float32),
        np.zeros(count, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )


def materials(values: np.ndarray) -> dict[str, np.ndarray]:
    """Channels of materials from albedo, metallic and roughness side by side, shape (n, 5)."""
    columns = values.astype(np.float32)
    parts = {"albedo": columns[:, :3], "metallic": columns[:, 3:4], "roughness": columns[:, 4:5]}
    return {name: np.ascontiguousarray(part) for name, part in parts.items()}


def test_scene_materials_need_all_three_channels() -> None:
    channels = materials(np.linspace(0.0, 1.0, 20).reshape(4, 5))
    whole = plain(4).with_channels(channels)
    require_materials(whole, Path("scene.ply"))
    for name in channels:
        part = whole.without_channels([name])
        assert not has_materials(part)
        with pytest.raises(ConfigError, match=r"scene\.ply has no materials .*--materials"):
            require_materials(part, Path("scene.ply"))
    assert not has_materials(whole.with_channels({"metallic": np.zeros((4, 2), np.float32)}))


def test_smooth_metal_is_reflective() -> None:
    values = np.array([[0.5, 0.5, 0.5, 0.9, 0.1], [0.5, 0.5, 0.5, 0.9, 0.9], [0.5, 0.5, 0.5, 0.1, 0.1]])
    scene = plain(3)
    scene.log_scales[0] = np.log(2)  # four times the area
    assert reflective_fraction(scene.with_channels(materials(values))) == pytest.approx(4 / 6)
