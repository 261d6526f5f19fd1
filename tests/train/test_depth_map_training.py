"""Depth maps hold the geometry of a training: the loss by finite differences, and what it does."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.events import CheckpointWritten, Event, Warned
from octasplat.engine.dataset import Dataset
from octasplat.engine.files import read_scene
from octasplat.engine.pipeline import BlockRequest, reconstruct
from octasplat.engine.runs.config import ReconstructionConfig, resolve_config
from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.train.config import LossWeights, TrainConfig, uses_shared_sort, with_depth_weight
from octasplat.engine.train.initialization.initial_gaussians import initial_train_state
from octasplat.engine.train.loop.iteration import loss_and_gradients
from octasplat.engine.train.optimization.depth_loss import ROUNDING, depth_differences
from octasplat.engine.train.sampling.batches import Batch
from tests.support.planar_dataset import PlanarDataset
from tests.support.tiny_dataset import make_tiny_dataset

pytestmark = pytest.mark.heavy

SETTINGS = {
    "rays_per_batch": 1024, "max_gaussians": 1500, "initial_points": 800, "probe_rays": 256,
    "iterations": 300, "densify_from_iter": 0, "rebuild_every": 20, "checkpoint_every": 100,
}  # fmt: skip


def make_config(**changes: object) -> ReconstructionConfig:
    assignments = [f"{name}={value}" for name, value in {**SETTINGS, **changes}.items()]
    return resolve_config("fast", settings={"exports": (), "test_every": 4}, assignments=assignments)


@pytest.fixture(scope="module")
def plain_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory, views=16, width_px=96, height_px=72)


@pytest.fixture(scope="module")
def measured_scene(plain_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = tmp_path_factory.mktemp("measured") / "scene"
    shutil.copytree(plain_scene, scene)
    shutil.copytree(scene / "ground_truth" / "depth", scene / "depths")
    return scene


def depth_error(scene: Path, run: Path, cache: Path) -> float:
    """Median difference of rendered and true depths over the held-out views, as a share of the depth."""
    dataset = Dataset.open(scene, cache, test_every=4)
    tracer = make_tracer()
    tracer.build(read_scene(run / "scene.ply")[0])
    differences = []
    for view in dataset.test_indices.tolist():
        width, height = dataset.views[view].width_px, dataset.views[view].height_px
        y, x = np.divmod(np.arange(width * height), width)
        pixels = np.full(len(y), view), y, x
        known = dataset.known_distances(*pixels)
        found = tracer.trace(dataset.rays(*pixels)).expected_depth
        differences.append(np.abs(found - known)[known > 0] / known[known > 0])
    return float(np.median(np.concatenate(differences)))


def test_gradient_of_the_depth_term_is_its_slope() -> None:
    world = PlanarDataset()
    start = world.initial_gaussians(count=60, painted=True, opacity=0.6)
    start.means_world[:, 2] += np.random.default_rng(2).normal(0, 0.1, 60)
    rng = np.random.default_rng(0)
    view, y, x = rng.integers(1, 7, 300), rng.integers(0, 40, 300), rng.integers(0, 40, 300)
    rays = world.rays(view, y, x)
    known = (-rays.origins_world[:, 2] / rays.directions_world[:, 2]).astype(np.float32)
    known[::3] = 0.0  # nothing is known there
    nothing = np.zeros(300, np.float32)
    batch = Batch(
        rays, np.zeros((300, 3), np.float32), nothing, nothing, view, 0, 8, np.zeros(3, np.float32),
        known_distances=known,
    )  # fmt: skip

    def loss(depth: np.ndarray) -> float:
        moved = replace(
            start, means_world=np.column_stack([start.means_world[:, :2], depth]).astype(np.float32)
        )
        tracer = make_tracer()
        tracer.build(moved)
        difference = depth_differences(tracer.trace(rays), known)
        return 0.3 * float((np.sqrt(difference**2 + ROUNDING**2) - ROUNDING).mean())

    tracer = make_tracer()
    tracer.build(start)
    found = loss_and_gradients(
        batch, tracer, PLAIN_SHADING, LossWeights(depth=0.3), training_progress=0.5
    ).gaussians
    z = start.means_world[:, 2].astype(np.float64)
    strongest = np.argsort(-np.abs(found.means_world[:, 2]))[:5]
    for row in strongest:
        step = np.zeros(60)
        step[found.ids[row]] = 2e-3
        slope = (loss(z + step) - loss(z - step)) / 4e-3
        assert found.means_world[row, 2] == pytest.approx(slope, rel=0.05)


def test_depth_weight_is_decided_by_the_maps() -> None:
    config = TrainConfig()
    assert with_depth_weight(config, has_depth_maps=False) == config
    measured = with_depth_weight(config, has_depth_maps=True)
    assert measured.loss.depth == 0.1 and not uses_shared_sort(measured)
    off = config.model_copy(update={"loss": config.loss.model_copy(update={"depth": 0.0})})
    assert with_depth_weight(off, has_depth_maps=True).loss.depth == 0.0
    assert uses_shared_sort(with_depth_weight(off, has_depth_maps=True)) == uses_shared_sort(config)


@pytest.mark.exhaustive
def test_maps_make_the_geometry_right(plain_scene: Path, measured_scene: Path, tmp_path: Path) -> None:
    plain = reconstruct(plain_scene, tmp_path / "plain", make_config())
    measured = reconstruct(measured_scene, tmp_path / "measured", make_config())
    errors = [depth_error(measured_scene, run, tmp_path / "cache") for run in (plain, measured)]
    assert errors[1] < 0.5 * errors[0]
    assert errors[1] < 0.03


@pytest.mark.exhaustive
def test_known_geometry_makes_the_geometry_right(
    plain_scene: Path, measured_scene: Path, tmp_path: Path
) -> None:
    scene = tmp_path / "scene"
    shutil.copytree(plain_scene, scene)
    shutil.copy(scene / "ground_truth" / "mesh.ply", scene / "geometry.ply")
    events: list[Event] = []
    run = reconstruct(scene, tmp_path / "run", make_config(), progress=events.append)
    assert depth_error(measured_scene, run, tmp_path / "cache") < 0.03
    messages = [event.message for event in events if isinstance(event, Warned)]
    assert any("geometry.ply is taken as known geometry; 16 photographs see it" in text for text in messages)


def without_points(model: Path) -> None:
    reconstruction = pycolmap.Reconstruction(str(model))
    for number in list(reconstruction.points3D):
        reconstruction.delete_point3D(number)
    reconstruction.write_binary(str(model))


def test_few_maps_and_no_sparse_points_begin_a_training(measured_scene: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    shutil.copytree(measured_scene, scene)
    for path in sorted((scene / "depths").iterdir())[3:]:
        path.unlink()
    config = TrainConfig(initial_points=400, max_gaussians=400)
    dataset = Dataset.open(scene, tmp_path / "cache", test_every=4)
    # pixels of photographs without a map are lifted by a plane sweep
    swept = len(initial_train_state(dataset, config).gaussians)
    without_points(scene / "sparse" / "0")
    bare = Dataset.open(scene, tmp_path / "cache", test_every=4)
    assert len(bare.points) == 0
    lifted = len(initial_train_state(bare, config).gaussians)
    assert 50 < lifted < swept - 200 and swept <= 400


@pytest.mark.exhaustive
def test_stopped_training_with_maps_goes_on_to_the_same_bytes(measured_scene: Path, tmp_path: Path) -> None:
    whole = reconstruct(measured_scene, tmp_path / "whole", make_config(), threads=1)
    stop = [False]

    def note(event: Event) -> None:
        stop[0] = stop[0] or isinstance(event, CheckpointWritten)

    with pytest.raises(CancelledError):
        reconstruct(
            measured_scene, tmp_path / "parts", make_config(), progress=note, should_stop=lambda: stop[0]
        )
    resumed = reconstruct(measured_scene, tmp_path / "parts", make_config(), resume=True, threads=2)
    assert (resumed / "scene.ply").read_bytes() == (whole / "scene.ply").read_bytes()


@pytest.mark.exhaustive
def test_blocks_see_the_maps(measured_scene: Path, tmp_path: Path) -> None:
    run = reconstruct(measured_scene, tmp_path / "run", make_config(), blocks=BlockRequest(count=2))
    assert depth_error(measured_scene, run, tmp_path / "cache") < 0.05
