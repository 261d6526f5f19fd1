"""Scales do not fall below what a photograph can show."""

from pathlib import Path

import numpy as np
from scipy.spatial.distance import cdist

from octasplat.engine.train.loop.state import MinScale, initial_state
from octasplat.engine.train.loop.trainer import Trainer
from tests.support.planar_dataset import PlanarDataset, small_config


def test_min_scale_is_enforced(tmp_path: Path) -> None:
    world = PlanarDataset()
    start = world.initial_gaussians()
    start.log_scales[:50] = np.log(1e-4)
    floor = MinScale(world.origins[world.train_indices], 0.02)
    trained = Trainer(
        world, small_config(iterations=40), initial_state(start, 0), folder=tmp_path, fingerprint="test",
        progress=lambda _event: None, threads=1, min_scale=floor,
    ).run()  # fmt: skip
    away = cdist(trained.means_world, floor.origins_world).min(axis=1)
    assert (trained.scales >= 0.02 * away[:, None] * (1 - 1e-5)).all()
    assert (trained.scales < 0.021 * away[:, None]).any()
