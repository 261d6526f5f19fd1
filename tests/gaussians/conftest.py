from collections.abc import Callable

import numpy as np
import pytest

from engine.gaussians.model import FlatGaussians


@pytest.fixture
def make_gaussians() -> Callable[..., FlatGaussians]:
    def make(count: int, sh_degree: int = 0, seed: int = 0) -> FlatGaussians:
        random = np.random.default_rng(seed)

        def normal(*shape: int) -> np.ndarray:
            return random.standard_normal(shape, dtype=np.float32)

        return FlatGaussians(
            means_world=normal(count, 3),
            quats_wxyz=normal(count, 4) * 3,
            log_scales=normal(count, 2) - 3,
            opacity_logits=normal(count) + 1,
            sh=normal(count, (sh_degree + 1) ** 2, 3),
        )

    return make
