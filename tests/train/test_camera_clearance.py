"""Nothing stays nearer to a camera than what its photograph can show."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.camera_clearance import CameraClearance, camera_clearances
from octasplat.engine.dataset.model import PosedView, SparsePoints, Viewpoints
from octasplat.engine.dataset.view_frusta import ViewFrusta
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.train.loop.state import initial_state
from octasplat.engine.train.loop.trainer import Trainer
from tests.support.planar_dataset import PlanarDataset, small_config

WIDE = Camera("OPENCV", (50.0, 50.0, 40.0, 40.0, -0.2, 0.0, 0.0, 0.0), 80, 80)
PINHOLE = Camera("PINHOLE", (40.0, 40.0, 20.0, 20.0), 40, 40)


def cloud(points: np.ndarray) -> SparsePoints:
    n = len(points)
    return SparsePoints(
        points.astype(np.float32),
        np.zeros((n, 3), np.float32),
        np.full(n, 3, np.int32),
        np.zeros(n, np.float32),
        np.arange(n),
    )


def seen_from(*positions: tuple[float, float, float]) -> Viewpoints:
    """Views that look along z: all through the pinhole, the last through the wide lens."""
    last = len(positions) - 1
    views = tuple(
        PosedView(f"{k}.png", int(k == last), np.eye(3), -np.array(position, np.float64), 40, 40)
        for k, position in enumerate(positions)
    )
    return Viewpoints(views, (PINHOLE, WIDE))


def test_distances_begin_where_the_sparse_points_do() -> None:
    rng = np.random.default_rng(0)
    wall = np.concatenate([rng.uniform(-3, 3, (2000, 2)), np.full((2000, 1), 4.0)], axis=1)
    strays = np.array([[0.0, 0.0, 0.2]] * 5 + [[0.0, 0.0, -1.0]])
    trunk = np.array([[0.0, 0.0, 9.0]]) + rng.uniform(-0.01, 0.01, (10, 3))
    scene = seen_from((0, 0, 0), (0, 0, 1), (90, 0, 4), (0, 0, 10))
    found = camera_clearances(scene, cloud(np.concatenate([wall, strays, trunk])))
    assert found[:2] == pytest.approx([4.0, 3.0], rel=0.01)
    assert found[2] == pytest.approx(87.0, rel=0.01)
    assert found[3] == pytest.approx(1.0, rel=0.02)  # though it looks the other way
    assert (camera_clearances(scene, cloud(wall[:40])) == 0).all()


def test_camera_clearance_zone_is_sphere() -> None:
    scene = seen_from((0, 0, 0), (10, 0, 0), (20, 0, 0))
    zones = CameraClearance.from_views(scene, np.array([1.0, 2.0, 0.0]), np.arange(3))
    points = [
        (0.0, 0.0, 0.5), (0.6, -0.6, 0.45), (0.6, -0.6, 0.6), (0.0, 0.0, 1.01), (0.0, 0.0, -0.5),
        (10.0, 0.0, 1.9), (10.0, 0.0, 2.1), (10 + 1.9, 0.0, -0.1), (20.0, 0.0, 0.0),
    ]  # fmt: skip
    expected = [True, True, False, False, True, True, False, True, False]
    assert zones.contains(np.array(points)).tolist() == expected
    assert zones.contains(np.empty((0, 3))).tolist() == []
    assert zones.scaled(1.2).contains(np.array(points)).tolist() == [True] * 8 + [False]
    assert not CameraClearance.from_views(scene, np.zeros(3), np.arange(3)).contains(np.array(points)).any()


def test_training_prunes_gaussians_near_cameras(tmp_path: Path) -> None:
    world = PlanarDataset()
    veil = world.initial_gaussians(60, opacity=0.9)
    veil.means_world = (
        world.origins[3] + [0, 0, 0.4] + np.random.default_rng(4).normal(0, 0.05, (60, 3))
    ).astype(np.float32)
    zones = CameraClearance(world.views, np.full(7, 1.0))

    def trained(near_zones: CameraClearance | None) -> tuple[FlatGaussians, Trainer]:
        trainer = Trainer(
            world, small_config(), initial_state(concatenate([world.initial_gaussians(), veil]), 0),
            folder=tmp_path, fingerprint="test", progress=lambda _event: None, threads=1,
            camera_clearance=near_zones,
        )  # fmt: skip
        return trainer.run(), trainer

    cleared, trainer = trained(zones)
    assert not zones.scaled(1.5).contains(cleared.means_world).any()  # what gathers at the rim neither
    assert trainer.state.pruned_near_cameras >= 30
    left, without = trained(None)
    assert zones.contains(left.means_world).any()
    assert trainer.views is not None and without.views is not None
    assert trainer.views.psnr["3.png"] > without.views.psnr["3.png"]


def test_unseen_gaussians_are_pruned(tmp_path: Path) -> None:
    world = PlanarDataset()
    camera = Camera("PINHOLE", (40.0, 40.0, 20.0, 20.0), 40, 40)  # sees half as far to each side as ahead
    space = ViewFrusta(world.views, (camera,))
    first = world.views[0]
    seen_cam = np.array([[0.0, 0.0, 0.01], [0.49, -0.49, 1.0], [50.0, 0.0, 101.0]])
    unseen_cam = np.array([[0.51, 0.0, 1.0], [0.0, 0.0, -1.0]])
    alone = ViewFrusta([first], (camera,))
    for points_cam, expected in ((seen_cam, True), (unseen_cam, False)):
        points_world = (points_cam - first.translation_cam_from_world) @ first.rotation_cam_from_world
        assert (alone.contains(points_world) == expected).all()
    assert not ViewFrusta([], (camera,)).contains(seen_cam).any()

    lamps = world.initial_gaussians(20, opacity=0.9)
    lamps.means_world += np.float32([90.0, 0.0, 0.0])
    assert not space.contains(lamps.means_world).any()

    def trained(seen_space: ViewFrusta | None) -> FlatGaussians:
        start = initial_state(concatenate([world.initial_gaussians(), lamps]), 0)
        return Trainer(
            world, small_config(), start, folder=tmp_path, fingerprint="test", progress=lambda _event: None,
            threads=1, view_frusta=seen_space,
        ).run()  # fmt: skip

    assert space.contains(trained(space).means_world).all()
    assert not space.contains(trained(None).means_world).all()
