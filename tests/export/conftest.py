from collections.abc import Callable

import numpy as np
import pytest

from engine.gaussians.model import FlatGaussians


@pytest.fixture
def make_scene() -> Callable[..., FlatGaussians]:
    """Random scenes in which some Gaussians are too faint for an octagon and some colours leave [0, 1]."""

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
