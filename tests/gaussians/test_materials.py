"""Which scenes have materials, and what their numbers mean."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.gaussians.materials import (
    f0_linear,
    has_materials,
    reflective_fraction,
    require_materials,
    split_materials,
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


def test_scene_materials_need_all_three_channels() -> None:
    channels = split_materials(np.linspace(-0.1, 1.1, 20).reshape(4, 5))
    assert channels["albedo"].min() == 0 and channels["roughness"].max() == 1
    whole = plain(4).with_channels(channels)
    require_materials(whole, Path("scene.ply"))
    for name in channels:
        part = whole.without_channels([name])
        assert not has_materials(part)
        with pytest.raises(ConfigError, match=r"scene\.ply has no materials .*--materials"):
            require_materials(part, Path("scene.ply"))
    assert not has_materials(whole.with_channels({"metallic": np.zeros((4, 2), np.float32)}))


def test_base_reflectance_of_metal_and_dielectric() -> None:
    albedo = np.array([[0.9, 0.5, 0.1]] * 3)
    f0 = f0_linear(albedo, np.array([[0.0], [1.0], [0.5]]))
    np.testing.assert_allclose(f0, [[0.04] * 3, [0.9, 0.5, 0.1], [0.47, 0.27, 0.07]])


def test_smooth_metal_is_reflective() -> None:
    values = np.array([[0.5, 0.5, 0.5, 0.9, 0.1], [0.5, 0.5, 0.5, 0.9, 0.9], [0.5, 0.5, 0.5, 0.1, 0.1]])
    scene = plain(3)
    scene.log_scales[0] = np.log(2)  # four times the area
    assert reflective_fraction(scene.with_channels(split_materials(values))) == pytest.approx(4 / 6)
