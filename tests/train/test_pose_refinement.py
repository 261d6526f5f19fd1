"""Poses that are a little wrong come right in the training, where that is asked for."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octasplat.engine.core.errors import CancelledError, ConfigError
from octasplat.engine.core.events import Event, HeldOutMeasured, Warned, ignore_events
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.dataset import Camera, DatasetView
from octasplat.engine.dataset.view_frusta import cam_from_world
from octasplat.engine.gaussians.rows import row_arrays
from octasplat.engine.runs.config import resolve_config
from octasplat.engine.train.loop.checkpoint import BestState, latest_checkpoint, load_checkpoint, save_best
from octasplat.engine.train.loop.state import TrainState, initial_state
from octasplat.engine.train.loop.trainer import Trainer
from octasplat.engine.train.sampling.batches import grid_pixels
from octasplat.engine.train.sampling.pixel_sampler import view_sizes_px
from octasplat.engine.train.views.corrected_views import correct_view, remove_common_motion
from octasplat.engine.train.views.image_alignment import (
    PhotographSamples,
    RenderedPoints,
    RigidMotion,
    align_camera,
    photograph_spline,
)
from octasplat.engine.train.views.pose_refinement import RefinedPose
from tests.support.planar_dataset import PlanarDataset, small_config

SIDE_PX, FOCAL_PX, DISTANCE = 48, 52.0, 2.0
WRONG_PX = 0.6
"""Standard deviation of where turn and shift each put the middle of the picture, across and down."""


class WrongWorld(PlanarDataset):
    """The painted plane from all around, with training views whose poses are not where they say."""

    detail = 2.0

    def __init__(self) -> None:
        super().__init__(count=12, side_px=SIDE_PX, held_out=2)
        rng = np.random.default_rng(5)
        self.cameras = (Camera("PINHOLE", (FOCAL_PX, FOCAL_PX, SIDE_PX / 2, SIDE_PX / 2), SIDE_PX, SIDE_PX),)
        self.true = tuple(self._looking_at_the_middle(view, rng) for view in self.views)
        turns, shifts = rng.normal(0, WRONG_PX / FOCAL_PX, (2, len(self.train_indices), 3))
        views = list(self.true)
        for index, turn, shift in zip(
            self.train_indices, turns - turns.mean(axis=0), shifts - shifts.mean(axis=0), strict=True
        ):  # nothing in common: that would be another place of the scene
            view = self.true[index]
            turned = view.rotation_cam_from_world @ Rotation.from_rotvec(turn).as_matrix()
            views[index] = posed(view, turned, view.origin_world + DISTANCE * shift)
        self.views = tuple(views)

    def _looking_at_the_middle(self, view: DatasetView, rng: np.random.Generator) -> DatasetView:
        origin = np.array([*rng.uniform(-1.2, 1.2, 2), -DISTANCE])
        forward = -origin / np.linalg.norm(origin)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        return posed(view, np.stack([right, np.cross(forward, right), forward]), origin)

    def rays(self, view: np.ndarray, y: np.ndarray, x: np.ndarray) -> RayBatch:
        return self._rays(self.views, view, y, x)

    def pixels(
        self, view: np.ndarray, y: np.ndarray, x: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.shown(self._rays(self.true, view, y, x))

    def _rays(
        self, views: tuple[DatasetView, ...], view: np.ndarray, y: np.ndarray, x: np.ndarray
    ) -> RayBatch:
        directions = self.cameras[0].directions_cam(np.stack([x + 0.5, y + 0.5], axis=1))
        rotations = np.stack([v.rotation_cam_from_world.T for v in views])
        origins = np.stack([v.origin_world for v in views])
        return RayBatch(origins[view], np.einsum("nij,nj->ni", rotations[view], directions))


def posed(view: DatasetView, rotation: np.ndarray, origin: np.ndarray) -> DatasetView:
    return replace(view, rotation_cam_from_world=rotation, translation_cam_from_world=-rotation @ origin)


def train(
    folder: Path,
    *,
    state: TrainState | None = None,
    threads: int = 1,
    should_stop: Callable[[], bool] = lambda: False,
    **settings: object,
) -> tuple[Trainer, list[Event]]:
    world, events = WrongWorld(), list[Event]()
    config = small_config(**{"sh_degree": 0, **settings})
    trainer = Trainer(
        world,
        config,
        state or initial_state(world.initial_gaussians(1000, 0.5, painted=True), config.seed),
        folder=folder,
        fingerprint="test",
        progress=events.append,
        threads=threads,
        should_stop=should_stop,
    )
    trainer.run()
    return trainer, events


def pose(view: DatasetView | RefinedPose) -> tuple[np.ndarray, np.ndarray]:
    return np.array(view.rotation_cam_from_world), np.array(view.translation_cam_from_world)


def misplaced_px(poses: Mapping[str, DatasetView | RefinedPose]) -> np.ndarray:
    """How far from where they are points of the plane are seen by each view, in the middle."""
    world = WrongWorld()
    true = {view.name: view for view in world.true}
    grid = np.stack(np.meshgrid(*[np.linspace(-0.6, 0.6, 5)] * 2), axis=-1).reshape(-1, 2)
    points = np.column_stack([grid, np.zeros(len(grid))])

    def seen(view: DatasetView | RefinedPose) -> np.ndarray:
        rotation, translation = pose(view)
        return world.cameras[0].project(points @ rotation.T + translation)

    away = [np.linalg.norm(seen(view) - seen(true[name]), axis=1) for name, view in poses.items()]
    return np.median(away, axis=1)


def last_psnr(events: list[Event]) -> float:
    return [event.psnr for event in events if isinstance(event, HeldOutMeasured)][-1]


def test_pose_refinement_corrects_poses_and_improves_held_out(tmp_path: Path) -> None:
    longer = {
        "iterations": 300,
        "rays_per_batch": 2048,
        "max_gaussians": 1500,
        "checkpoint_every": 100,
        "rebuild_every": 20,
    }
    _, plain = train(tmp_path / "plain", **longer)
    trainer, events = train(tmp_path / "refined", refine_poses=True, **longer)
    assert trainer.poses is not None
    given = WrongWorld()
    wrong = {given.views[i].name: given.views[i] for i in given.train_indices}
    found = trainer.poses.views
    assert found.keys() == wrong.keys()  # and none of those held out
    before, after = misplaced_px(wrong), misplaced_px(found)
    assert before.mean() > 1 and after.mean() < 0.5 * before.mean()
    assert last_psnr(events) > last_psnr(plain) + 3
    largest = max(found, key=lambda name: found[name].moved_px or 0)
    told = [event.message for event in events if isinstance(event, Warned)][-1]
    assert told.startswith("The poses of 10 of 10 training views were corrected, by ")
    assert told.endswith(f" px at most ({largest}).")


def test_pose_refinement_is_independent_of_exposure() -> None:
    world = WrongWorld()
    found = {}
    for index in world.train_indices.tolist():
        view, y, x = grid_pixels(np.array([index]), view_sizes_px(world), 5)
        rays = world.rays(view, y, x)
        origins, ways = rays.origins_world.astype(np.float64), rays.directions_world.astype(np.float64)
        plane = origins - ways * (origins[:, 2:] / ways[:, 2:])
        given = world.views[index]
        shown = 0.7 * world.shown(rays)[0].astype(np.float64) + 0.1
        look = photograph_spline(world, index, (SIDE_PX, SIDE_PX), np.zeros(3, np.float32))
        motion = align_camera(RenderedPoints(cam_from_world(plane, given), shown), look, world.cameras[0])
        assert motion is not None
        found[given.name] = correct_view(given, motion)
    assert misplaced_px(found).max() < 0.1


def test_pose_refinement_removes_global_motion() -> None:
    world = WrongWorld()
    corrections = np.zeros((len(world.views), 6))
    turn = Rotation.from_rotvec([0.01, -0.02, 0.015]).as_matrix()
    moving = world.train_indices[1:]
    for index in moving:
        view = world.views[index]
        origin = turn @ view.origin_world * 1.02 + [0.03, 0.01, -0.02]
        rotation = view.rotation_cam_from_world @ turn.T
        relative = rotation @ view.rotation_cam_from_world.T
        shift = -rotation @ origin - relative @ view.translation_cam_from_world
        corrections[index] = RigidMotion(relative, shift).to_vector
    left = remove_common_motion(corrections, world, moving)
    assert np.abs(corrections[moving]).max(axis=1).min() > 1e-2
    assert np.abs(left).max() < 1e-6
    # One that stays has a say, and stays.
    left = remove_common_motion(corrections, world, world.train_indices)
    assert (left[world.train_indices[0]] == 0).all() and (left[world.test_indices] == 0).all()


@pytest.mark.exhaustive
def test_stopped_and_on_other_threads_the_same_bits_come_out(tmp_path: Path) -> None:
    whole, _ = train(tmp_path / "whole", refine_poses=True, iterations=80)
    asked = 0

    def stop_now_and_then() -> bool:
        nonlocal asked
        asked += 1
        return asked % 3 == 0

    state, stops = None, 0
    while True:
        try:
            parts, _ = train(
                tmp_path / "parts", state=state, threads=2, should_stop=stop_now_and_then,
                refine_poses=True, iterations=80,
            )  # fmt: skip
            break
        except CancelledError:
            stops += 1
            path = latest_checkpoint(tmp_path / "parts")
            assert path is not None
            state = load_checkpoint(path, "test")
    assert stops > 1
    assert parts.state.pose_corrections.tobytes() == whole.state.pose_corrections.tobytes()
    assert whole.state.pose_corrections.any()
    for name, values in row_arrays(whole.state.gaussians).items():
        assert values.tobytes() == row_arrays(parts.state.gaussians)[name].tobytes(), name


def test_pose_refinement_best_checkpoint_restores_poses(tmp_path: Path) -> None:
    train(tmp_path, refine_poses=True, iterations=80)
    path = latest_checkpoint(tmp_path)
    assert path is not None
    state = load_checkpoint(path, "test")
    before = np.full_like(state.pose_corrections, 1e-3)
    save_best(BestState(state.gaussians.copy(), {}, before), tmp_path)
    state.best_psnr = 90.0
    trainer, _ = train(tmp_path, state=state, refine_poses=True, iterations=80)
    np.testing.assert_array_equal(trainer.state.pose_corrections, before)


def test_mirrors_and_photographs_without_cameras_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="reflections"):
        resolve_config("fast", materials=True, assignments=["refine_poses=true"])
    world, config = PlanarDataset(), small_config(refine_poses=True)
    with pytest.raises(ConfigError, match="without cameras"):
        Trainer(
            world,
            config,
            initial_state(world.initial_gaussians(), 0),
            folder=tmp_path,
            fingerprint="",
            progress=ignore_events,
        )


def test_panorama_with_as_much_ahead_as_behind_is_aligned() -> None:
    """Looking out of a painted ball, of radius 3, whose middle the camera is not quite in."""
    camera = Camera("EQUIRECTANGULAR", (512.0, 256.0), 512, 256)
    shift = np.array([0.03, -0.02, 0.025])
    waves = np.array([[1, 0.4, 0.3], [0.2, 1, -0.5], [-0.3, 0.5, 1]])

    def colors(points: np.ndarray) -> np.ndarray:
        return 0.5 + 0.3 * np.sin(1.3 * points @ waves.T + np.arange(3))

    def seen(pixels: np.ndarray) -> np.ndarray:
        ways = camera.directions_cam(pixels)
        along = ways @ shift
        return colors((np.sqrt(along**2 - shift @ shift + 9) + along)[:, None] * ways - shift)

    def photograph(pixels: np.ndarray) -> PhotographSamples:
        inside = ((pixels > 2) & (pixels < [510, 254])).all(axis=1)
        pixels = np.where(inside[:, None], pixels, 5.0)
        slopes = [seen(pixels + step) - seen(pixels - step) for step in ([0.5, 0.0], [0.0, 0.5])]
        return PhotographSamples(seen(pixels), np.stack(slopes, axis=-1), inside)

    points = np.random.default_rng(1).normal(size=(3000, 3))
    points *= 3 / np.linalg.norm(points, axis=1, keepdims=True)
    found = align_camera(RenderedPoints(points, colors(points)), photograph, camera)
    assert found is not None
    np.testing.assert_allclose(found.to_vector, [0, 0, 0, *shift], atol=2e-3)
