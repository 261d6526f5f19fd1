"""Opacities fade in the first half of a training where that is asked for."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.train.config import McmcConfig
from octasplat.engine.train.densify.opacity_decay import decayed_logits
from octasplat.engine.train.loop.state import initial_state
from octasplat.engine.train.loop.trainer import Trainer
from tests.support.planar_dataset import PlanarDataset, small_config


def test_decayed_opacities_are_a_share_of_what_they_were() -> None:
    logits = np.array([-20.0, -3.0, 0.0, 5.0, 30.0], np.float32)
    before, after = (1 / (1 + np.exp(-each.astype(float))) for each in (logits, decayed_logits(logits, 0.9)))
    assert after == pytest.approx(np.maximum(0.9 * before, 1e-6), rel=1e-5)


def test_unseen_gaussian_fades_until_half_of_the_training(tmp_path: Path) -> None:
    world = PlanarDataset()
    start = world.initial_gaussians()
    start.means_world[0] = [0, 0, -50]  # behind all cameras
    before = float(start.opacities[0])
    config = small_config(
        iterations=40, rebuild_every=10, opacity_decay=0.9, weight_averaging_start=1.0,
        densify=McmcConfig(start=100).model_dump(),
    )  # fmt: skip
    trained = Trainer(
        world, config, initial_state(start, 0), folder=tmp_path, fingerprint="test",
        progress=lambda _event: None, threads=1,
    ).run()  # fmt: skip
    unseen = np.argmin(trained.means_world[:, 2])
    assert trained.means_world[unseen, 2] == -50
    assert trained.opacities[unseen] == pytest.approx(before * 0.9**2, rel=1e-5)  # at 10 and 20 of 40
