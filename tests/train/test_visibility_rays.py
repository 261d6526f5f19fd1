"""Lines of sight of sparse points: where they end, and that what hides the points is taken away."""

from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.events import ignore_events
from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.model import Observations, SparsePoints
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.train.config import LossWeights, TrainConfig
from octasplat.engine.train.loop.state import initial_state
from octasplat.engine.train.loop.trainer import Trainer
from octasplat.engine.train.sampling.visibility_rays import VisibilityRays, free_space_gradient
from tests.support.planar_dataset import PlanarDataset, batch_source


class SeenWorld(PlanarDataset):
    """The plane with points on it that all cameras show."""

    def __init__(self, points: int = 200, error_px: float = 0.0) -> None:
        super().__init__()
        self.cameras = (Camera("PINHOLE", (40.0, 40.0, 20.0, 20.0), 40, 40),)
        rng = np.random.default_rng(7)
        xyz = np.concatenate([rng.uniform(-0.8, 0.8, (points, 2)), np.zeros((points, 1))], axis=1)
        ids = 3 * np.arange(points) + 5
        count = len(self.views)
        self.points = SparsePoints(
            xyz.astype(np.float32), np.zeros((points, 3), np.float32), np.full(points, count, np.int32),
            np.full(points, error_px, np.float32), ids,
        )  # fmt: skip
        view = np.repeat(np.arange(count), points)
        self.observations = Observations(view, np.tile(ids, count), np.zeros((len(view), 2)))


def test_visibility_rays_lead_from_cameras_to_known_points() -> None:
    world = SeenWorld(error_px=2.0)
    lines = VisibilityRays.from_dataset(world, 0.0)
    assert len(lines) == 200 * 6  # the seventh view is held out
    np.testing.assert_allclose(lines.starts_world[::200], world.origins[world.train_indices], atol=1e-6)
    # One of them by hand: rays to point 11 from all training cameras.
    point = world.points.xyz_world[11].astype(np.float64)
    ways = point - world.origins[world.train_indices]
    units = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    sines = 1 - (units @ units[2]) ** 2
    pixel = 1 / 40  # a pixel's tangent in the middle of the picture
    deviation = 2.0 * pixel * np.linalg.norm(ways[2]) / np.sqrt(sines.sum())
    row = 2 * 200 + 11
    np.testing.assert_allclose(lines.directions_world[row], units[2], atol=1e-6)
    assert lines.ends[row] == pytest.approx(np.linalg.norm(ways[2]) - 3 * deviation, rel=0.01)
    far = VisibilityRays.from_dataset(world, 0.45)
    np.testing.assert_allclose(far.ends[row], 0.55 * np.linalg.norm(ways[2]), rtol=1e-5)


def test_rarely_seen_points_have_no_visibility_rays() -> None:
    world = SeenWorld()
    seen = world.observations
    rare = (seen.point == 5) & (seen.view > 2)  # point 0: in views 0 (held out), 1 and 2
    world.observations = Observations(
        np.append(seen.view[~rare], 3), np.append(seen.point[~rare], 6), np.zeros(((~rare).sum() + 1, 2))
    )
    assert len(VisibilityRays.from_dataset(world, 0.0)) == 199 * 6


def test_visibility_loss_of_occluders_has_opacity_gradient() -> None:
    world = SeenWorld()
    veil = world.initial_gaussians(count=40, opacity=0.5)
    veil.means_world[:, 2] = -0.5
    tracer = make_tracer()
    tracer.build(veil, np.zeros((40, 0), np.float32))
    lines = VisibilityRays.from_dataset(world, 0.0).draw(np.random.default_rng(0), 500)
    hits, by = free_space_gradient(lines, tracer, 0.3)
    found = tracer.backward(hits, by).numpy()

    def cost(logits: np.ndarray) -> float:
        changed = FlatGaussians(
            veil.means_world, veil.quats_wxyz, veil.log_scales, logits.astype(np.float32), veil.sh
        )
        other = make_tracer()
        other.build(changed, np.zeros((40, 0), np.float32))
        return 0.3 * float((1 - other.transmittance(lines).astype(np.float64)).mean())

    assert len(found.opacity_logits) >= 3
    for row in np.argsort(-np.abs(found.opacity_logits))[:3]:
        step = np.zeros(40)
        step[found.ids[row]] = 0.02
        slope = (cost(veil.opacity_logits + step) - cost(veil.opacity_logits - step)) / 0.04
        assert found.opacity_logits[row] == pytest.approx(slope, rel=0.03)


def test_lines_that_are_hidden_less_than_allowed_have_no_gradient() -> None:
    world = SeenWorld()
    veil = world.initial_gaussians(count=40, opacity=0.5)
    veil.means_world[:, 2] = -0.5
    tracer = make_tracer()
    tracer.build(veil, np.zeros((40, 0), np.float32))
    lines = VisibilityRays.from_dataset(world, 0.0).draw(np.random.default_rng(0), 500)
    hidden = 1 - tracer.transmittance(lines)
    allowed = float(np.sort(hidden)[250:252].mean())
    assert hidden.min() < allowed < hidden.max()
    _, by_all = free_space_gradient(lines, tracer, 0.3)
    _, by_some = free_space_gradient(lines, tracer, 0.3, min_hidden=allowed)
    assert by_all.transmittance is not None and by_some.transmittance is not None
    np.testing.assert_array_equal(by_all.transmittance, np.float32(-0.3 / 500))
    expected = np.where(hidden >= allowed, np.float32(-0.3 / 500), np.float32(0.0))
    np.testing.assert_array_equal(by_some.transmittance, expected)


@pytest.mark.parametrize(("hidden_from", "is_kept"), [(None, False), (0.6, True)])
def test_training_keeps_a_faint_veil_where_it_may_hide_as_much(
    tmp_path: Path, hidden_from: float | None, is_kept: bool
) -> None:
    world = SeenWorld()
    start = world.initial_gaussians(painted=True, opacity=0.9)
    veil = world.initial_gaussians(count=60, painted=True, opacity=0.3)
    veil.means_world[:, 2] = -0.6
    lines = VisibilityRays.from_dataset(world, 0.05).draw(np.random.default_rng(1), 2000)
    hidden = []
    for weight in (0.0, 0.1):
        config = TrainConfig(
            iterations=60, rays_per_batch=1024, rebuild_every=20, densify_from_iter=1000,
            plane_sweep_init=False, visibility_ray_fraction=0.25,
            loss=LossWeights(free_space=weight, free_space_from=hidden_from),
        )  # fmt: skip
        state = initial_state(concatenate([start.copy(), veil.copy()]), seed=0)
        folder = tmp_path / str(weight)
        trainer = Trainer(world, config, state, folder=folder, fingerprint="", progress=ignore_events)
        done = trainer.run()
        tracer = make_tracer()
        tracer.build(done, np.zeros((len(done), 0), np.float32))
        hidden.append(float(1 - tracer.transmittance(lines).mean()))
    assert (hidden[1] > 0.6 * hidden[0]) == is_kept


def test_training_removes_veil_only_along_visibility_rays(tmp_path: Path) -> None:
    world = SeenWorld()
    hidden = {}
    for weight in (0.0, 0.1):
        start = world.initial_gaussians(painted=True, opacity=0.9)
        veil = world.initial_gaussians(count=60, painted=True, opacity=0.3)
        veil.means_world[:, 2] = -0.6
        config = TrainConfig(
            iterations=60,
            rays_per_batch=1024,
            rebuild_every=20,
            densify_from_iter=1000,
            plane_sweep_init=False,
            visibility_ray_fraction=0.25,
            loss=LossWeights(free_space=weight),
        )
        state = initial_state(concatenate([start, veil]), seed=0)
        trainer = Trainer(
            world, config, state, folder=tmp_path / str(weight), fingerprint="", progress=lambda event: None
        )
        done = trainer.run()
        tracer = make_tracer()
        tracer.build(done, np.zeros((len(done), 0), np.float32))
        lines = VisibilityRays.from_dataset(world, 0.05).draw(np.random.default_rng(1), 2000)
        hidden[weight] = float(1 - tracer.transmittance(lines).mean())
    assert hidden[0.0] > 0.1
    assert hidden[0.1] < 0.3 * hidden[0.0]


def test_batches_have_lines_where_they_count_and_none_of_views_left_out() -> None:
    world, rng = SeenWorld(), np.random.default_rng(0)
    assert batch_source(world, TrainConfig(rays_per_batch=1024)).draw(rng).visibility_rays is None
    assert batch_source(PlanarDataset(), _counting(0.1)).draw(rng).visibility_rays is None  # shows no points
    assert batch_source(SeenWorld(points=0), _counting(0.1)).draw(rng).visibility_rays is None
    source = batch_source(world, _counting(0.1))
    lines = source.draw(rng).visibility_rays
    assert lines is not None and len(lines) == 102
    assert len(np.unique(lines.origins_world, axis=0)) == 6
    source.exclude_views(np.array([2, 5]))
    lines = source.draw(rng).visibility_rays
    assert lines is not None
    assert len(np.unique(lines.origins_world, axis=0)) == 4


def test_refined_poses_leave_the_lines_of_sight(tmp_path: Path) -> None:
    ends = {}
    for weight in (0.0, 0.1):
        world = SeenWorld()
        config = TrainConfig(
            iterations=5, rays_per_batch=256, plane_sweep_init=False, refine_poses=True,
            visibility_ray_fraction=0.25, loss=LossWeights(free_space=weight),
        )  # fmt: skip
        state = initial_state(world.initial_gaussians(count=60, painted=True, opacity=0.3), seed=0)
        state.gaussians.means_world[:, 2] = -0.6
        trainer = Trainer(
            world, config, state, folder=tmp_path / str(weight), fingerprint="", progress=ignore_events
        )
        ends[weight] = trainer.run().opacity_logits.mean()
    assert ends[0.1] < ends[0.0] - 1e-3  # what hides the points becomes less opaque


def _counting(share: float) -> TrainConfig:
    return TrainConfig(rays_per_batch=1024, visibility_ray_fraction=share, loss=LossWeights(free_space=0.05))
