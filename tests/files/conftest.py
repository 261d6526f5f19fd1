import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.gaussians.flattening import GaussianCloud
from octasplat.engine.gaussians.model import FlatGaussians

SH_C0 = 0.28209479177387814


@pytest.fixture
def make_cloud() -> Callable[..., GaussianCloud]:
    """Random Gaussians with three extents, within what every format can hold."""

    def make(count: int, sh_degree: int = 0, seed: int = 0) -> GaussianCloud:
        random = np.random.default_rng(seed)

        def uniform(low: float, high: float, *shape: int) -> np.ndarray:
            return random.uniform(low, high, shape).astype(np.float32)

        quats = random.standard_normal((count, 4)).astype(np.float32)
        return GaussianCloud(
            means_world=uniform(-3, 3, count, 3),
            quats_wxyz=quats / np.linalg.norm(quats, axis=1, keepdims=True),
            log_scales=uniform(-6, -1, count, 3),
            opacity_logits=uniform(-4, 4, count),
            sh=np.concatenate(
                [
                    uniform(-0.5, 0.5, count, 1, 3) / np.float32(SH_C0),
                    uniform(-0.9, 0.9, count, (sh_degree + 1) ** 2 - 1, 3),
                ],
                axis=1,
            ).astype(np.float32),
        )

    return make


@pytest.fixture(scope="session")
def splats() -> Path:
    """Folder of trained splats of other programs, beside the photographed scenes."""
    scenes = os.environ.get("OCTASPLAT_SCENES")
    if not scenes:
        pytest.skip("OCTASPLAT_SCENES does not name a folder of photographed scenes")
    folder = Path(scenes).parent / "splats"
    if not folder.is_dir():
        pytest.skip("there is no folder 'splats' beside OCTASPLAT_SCENES")
    return folder


@pytest.fixture
def make_scene() -> Callable[..., FlatGaussians]:
    """Random scenes in which some Gaussians are too faint for an octagon and some colors leave [0, 1]."""

    def make(count: int, seed: int = 0) -> FlatGaussians:
        random = np.random.default_rng(seed)

        def normal(*shape: int) -> np.ndarray:
            return random.standard_normal(shape, dtype=np.float32)

        scene = FlatGaussians(
            means_world=normal(count, 3) * 2,
            quats_wxyz=normal(count, 4),
            log_scales=normal(count, 2) * np.float32(0.5) - 2,
            opacity_logits=normal(count) * 2,
            sh=normal(count, 4, 3) * 2,
        )
        scene.opacity_logits[::7] = -8.0
        return scene

    return make
