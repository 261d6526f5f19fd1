"""Pixels lifted from photographs taken a metre apart along a wall."""

import numpy as np
import pytest

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.dataset import Camera, Dataset, PosedView
from octasplat.engine.dataset.model import Observations, SparsePoints
from octasplat.engine.train.initialization.plane_sweep import plane_sweep_points

WIDTH, HEIGHT, FOCAL, AWAY = 80, 60, 50.0, 2.0


def paint(xy: np.ndarray) -> np.ndarray:
    """Colors of the wall z = 0 in [0.1, 0.9], nowhere twice the same."""
    random = np.random.default_rng(3)
    waves = random.uniform(-9, 9, (12, 2))
    phases, mix = random.uniform(0, 6, 12), random.uniform(-1, 1, (12, 3))
    rgb = np.sin(xy @ waves.T + phases) @ mix
    return (0.5 + 0.4 * np.tanh(rgb)).astype(np.float32)


class Wall(Dataset):
    """``count`` views of the wall, and 20 sparse points in each metre of it."""

    has_alpha = False
    extent = 1.0

    def __init__(self, count: int) -> None:
        random = np.random.default_rng(1)
        camera = Camera("PINHOLE", (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2), WIDTH, HEIGHT)
        self.origins = np.stack(
            [np.arange(count), random.uniform(-0.1, 0.1, count), np.full(count, -AWAY)], 1
        )
        self.views = tuple(  # type: ignore[assignment]
            PosedView(f"{k}", 0, np.eye(3), -origin, WIDTH, HEIGHT) for k, origin in enumerate(self.origins)
        )
        self.cameras = (camera,)
        self.train_indices, self.test_indices = np.arange(count), np.arange(0)
        xyz = np.zeros((20 * count, 3))
        xyz[:, :2] = random.uniform([-1, -1], [count, 1], (20 * count, 2))
        self.points = SparsePoints(
            xyz.astype(np.float32),
            paint(xyz[:, :2]),
            np.full(len(xyz), 3, np.int32),
            np.zeros(len(xyz), np.float32),
            np.arange(len(xyz)),
        )
        seen = []
        for k, origin in enumerate(self.origins):
            px = camera.project(xyz - origin)
            inside = ((px >= 0) & (px < [WIDTH, HEIGHT])).all(axis=1)
            seen.append(np.stack([np.full(inside.sum(), k), np.flatnonzero(inside)], 1))
        pairs = np.concatenate(seen)
        self.observations = Observations(pairs[:, 0], pairs[:, 1], np.zeros((len(pairs), 2)))

    def rays(self, view: np.ndarray, y: np.ndarray, x: np.ndarray) -> RayBatch:
        ways = np.stack([x + 0.5 - WIDTH / 2, y + 0.5 - HEIGHT / 2, np.full(len(x), FOCAL)], axis=1)
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        return RayBatch(self.origins[view], ways)

    def pixels(self, view: np.ndarray, y: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, ...]:  # type: ignore[override]
        ways = np.stack([x + 0.5 - WIDTH / 2, y + 0.5 - HEIGHT / 2], axis=1) / FOCAL
        ones = np.ones(len(x), np.float32)
        return paint(self.origins[view][:, :2] + AWAY * ways), ones, ones


@pytest.mark.exhaustive
@pytest.mark.parametrize("count", [20, 200])
def test_pixels_are_lifted_onto_the_wall_however_long_it_is(count: int) -> None:
    wanted = 3 * count
    lifted = plane_sweep_points(Wall(count), wanted, np.random.default_rng(0))
    assert len(lifted) > 0.8 * wanted
    assert np.median(np.abs(lifted.xyz_world[:, 2])) < 0.05
    along = np.histogram(lifted.xyz_world[:, 0], bins=10, range=(0, count - 1))[0]
    assert along.min() > 0.3 * len(lifted) / 10
