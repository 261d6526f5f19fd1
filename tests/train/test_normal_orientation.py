"""Which side of a Gaussian is out: the one from which the training views see it."""

from pathlib import Path

import numpy as np

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.dataset import Camera, DatasetView
from octasplat.engine.gaussians.frames import frames_from_normals, quaternions_from_matrices
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.train.views.normal_orientation import orient_normals
from tests.support.planar_dataset import PlanarDataset


def test_normals_seen_from_behind_are_flipped() -> None:
    world = PlanarDataset()
    gaussians = world.initial_gaussians(opacity=0.3)
    rng = np.random.default_rng(5)
    gaussians.quats_wxyz = rng.normal(size=(len(gaussians), 4)).astype(np.float32)
    before = gaussians.select(np.arange(len(gaussians)))
    tracer = make_tracer()
    tracer.build(gaussians, np.zeros((len(gaussians), 3), np.float32))
    rays = world.rays(np.zeros(300, np.int64), rng.integers(0, 40, 300), rng.integers(0, 40, 300))
    as_before = tracer.trace(rays)

    turned = orient_normals(gaussians, world, world.train_indices, tracer)

    assert 100 < len(turned) < 200  # about half of 300
    np.testing.assert_allclose(
        gaussians.rotations[turned][:, :, 0], -before.rotations[turned][:, :, 0], atol=1e-6
    )
    others = np.setdiff1d(np.arange(len(gaussians)), turned)
    assert np.array_equal(gaussians.quats_wxyz[others], before.quats_wxyz[others])
    # The cameras stand at z = -2: but for those seen at grazing angles or hidden, normals now point there.
    steep = np.abs(gaussians.rotations[:, 2, 0]) > 0.6
    assert (gaussians.rotations[steep, 2, 0] < 0).mean() > 0.98
    tracer.refresh(turned)
    seen = tracer.trace(rays)
    for name in ("rgb_srgb", "transmittance", "depth_sum", "normal_world"):
        np.testing.assert_allclose(getattr(seen, name), getattr(as_before, name), atol=2e-5)
    assert len(orient_normals(gaussians, world, world.train_indices, tracer)) == 0


class _ViewsOfABox(PlanarDataset):
    """Pinhole cameras that look at the origin."""

    def __init__(self, origins_world: np.ndarray, side_px: int = 48) -> None:
        super().__init__()
        self.origins_world = origins_world
        self.side_px = side_px
        self.views = tuple(
            DatasetView(f"{k}.png", 0, np.eye(3), -origin, side_px, side_px, Path(f"{k}.png"), None)
            for k, origin in enumerate(origins_world)
        )

    def rays(self, view: np.ndarray, y: np.ndarray, x: np.ndarray) -> RayBatch:
        """Return rays through the centres of pixels."""
        origins = self.origins_world[view]
        forward = -origins / np.linalg.norm(origins, axis=1, keepdims=True)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        down = np.cross(forward, right)
        across, along = ((np.asarray(c) + 0.5) / self.side_px - 0.5 for c in (x, y))
        ways = forward + across[:, None] * right + along[:, None] * down
        return RayBatch(origins, ways / np.linalg.norm(ways, axis=1, keepdims=True))


def _plate(height: float, normal_z: float, opacity: float) -> FlatGaussians:
    """A plate of 11 x 11 Gaussians, 1 wide, at a height."""
    steps = np.linspace(-0.5, 0.5, 11)
    x, y = (grid.ravel() for grid in np.meshgrid(steps, steps))
    means = np.stack([x, y, np.full(x.size, height)], axis=1).astype(np.float32)
    normals = np.tile([0.0, 0.0, normal_z], (x.size, 1))
    return FlatGaussians(
        means,
        quaternions_from_matrices(frames_from_normals(normals)).astype(np.float32),
        np.full((x.size, 2), np.log(0.08), np.float32),
        np.full(x.size, np.log(opacity / (1 - opacity)), np.float32),
        np.zeros((x.size, 1, 3), np.float32),
    )


def test_a_bottom_that_shines_faintly_through_the_top_still_points_down() -> None:
    """Many views see the top steeply, two see the bottom at 10 degrees; the top lets some light through."""
    turns = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    above = 3 * np.stack([0.6 * np.cos(turns), 0.6 * np.sin(turns), np.full(20, 0.8)], axis=1)
    below = 3 * np.array([[np.cos(0.17), 0.0, -np.sin(0.17)], [0.0, np.cos(0.17), -np.sin(0.17)]])
    world = _ViewsOfABox(np.concatenate([above, below]))
    top, bottom = _plate(0.05, 1.0, 0.7), _plate(-0.05, -1.0, 0.7)
    gaussians = concatenate([top, bottom])
    tracer = make_tracer()
    tracer.build(gaussians, np.zeros((len(gaussians), 3), np.float32))

    flipped_ids = orient_normals(gaussians, world, np.arange(22), tracer)

    assert len(flipped_ids) < 0.1 * len(bottom)
    upside_down = concatenate([_plate(0.05, -1.0, 0.7), bottom])
    tracer.build(upside_down, np.zeros((len(gaussians), 3), np.float32))
    flipped_ids = orient_normals(upside_down, world, np.arange(22), tracer)
    assert set(range(len(top))) <= set(flipped_ids.tolist())


class _ViewsDown(PlanarDataset):
    """Pinhole cameras that look along -z."""

    def __init__(self, origins_world: np.ndarray, side_px: int = 48) -> None:
        super().__init__()
        self.origins_world = origins_world
        self.side_px = side_px
        self.turn = np.diag([1.0, -1.0, -1.0])
        self.cameras = (Camera("PINHOLE", (side_px, side_px, side_px / 2, side_px / 2), side_px, side_px),)
        self.views = tuple(
            DatasetView(f"{k}.png", 0, self.turn, -self.turn @ origin, side_px, side_px, Path(), None)
            for k, origin in enumerate(origins_world)
        )

    def rays(self, view: np.ndarray, y: np.ndarray, x: np.ndarray) -> RayBatch:
        """Return rays through the centres of pixels."""
        across, along = ((np.asarray(c) + 0.5) / self.side_px - 0.5 for c in (x, y))
        ways = np.stack([across, along, np.ones_like(across)], axis=1) @ self.turn
        return RayBatch(self.origins_world[view], ways / np.linalg.norm(ways, axis=1, keepdims=True))


def test_cameras_that_look_elsewhere_do_not_tell_the_side_of_a_wall() -> None:
    """Three views see a wall from above; twelve stand below it, in another room, and look away from it."""
    spread = np.random.default_rng(3).uniform(-0.4, 0.4, (15, 2))
    heights = np.where(np.arange(15) < 3, 2.0, -2.0)
    world = _ViewsDown(np.concatenate([spread, heights[:, None]], axis=1))
    wall = _plate(0.0, -1.0, 0.9)
    tracer = make_tracer()
    tracer.build(wall, np.zeros((len(wall), 3), np.float32))

    flipped_ids = orient_normals(wall, world, np.arange(15), tracer)

    assert len(flipped_ids) == len(wall) and (wall.rotations[:, 2, 0] > 0.99).all()
