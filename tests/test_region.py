"""A region of a scene is trained in detail: its pixels are drawn more often, its Gaussians are more."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import CancelledError, ConfigError, DatasetError
from octasplat.engine.core.events import CheckpointWritten, Event, Noted
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.region import OUTSIDE_FREQUENCY, Region, passes_box, region_pixels
from octasplat.engine.dataset.view_tiles import FULL_FREQUENCY
from octasplat.engine.files import read_scene
from octasplat.engine.pipeline import BlockRequest, reconstruct
from octasplat.engine.runs.config import ReconstructionConfig, resolve_config
from octasplat.engine.settings.refusals import InvalidSettingsError
from octasplat.engine.train.sampling.pixel_sampler import pixel_sampler
from tests.support.planar_dataset import PlanarDataset
from tests.support.tiny_dataset import make_tiny_dataset

pytestmark = pytest.mark.heavy

BOX = (-0.5, -0.5, -0.2, 0.5, 0.5, 0.8)
SETTINGS: dict[str, object] = {
    "rays_per_batch": 512,
    "max_gaussians": 500,
    "initial_points": 300,
    "probe_rays": 256,
    "rebuild_every": 10,
    "checkpoint_every": 20,
    "densify.start": 20,
    "densify.interval": 10,
    "densify_from_iter": 0,
    "iterations": 120,
}


def make_config(region: tuple[float, ...] | None = None) -> ReconstructionConfig:
    return resolve_config(
        "fast",
        settings={"exports": (), "region": region},
        assignments=[f"{name}={json.dumps(value)}" for name, value in SETTINGS.items()],
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory, samples_per_side=2, points=300)


def test_rays_that_pass_a_box_are_those_with_a_point_in_it() -> None:
    rng = np.random.default_rng(0)
    origins = rng.uniform(-3, 3, (3000, 3))
    directions = rng.standard_normal((3000, 3))
    directions[:300, 0] = 0.0  # along the faces
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    corners = np.array([[-0.5, 0.2, -1.0], [0.7, 0.9, 0.4]])
    points = origins[:, None] + directions[:, None] * np.linspace(0, 8, 4001)[None, :, None]
    depth_in_box = np.minimum(points - corners[0], corners[1] - points).min(axis=2).max(axis=1)
    found = passes_box(origins, directions, corners)
    assert (
        found[depth_in_box >= 0].all() and not found[depth_in_box < -2e-3].any() and 50 < found.sum() < 1500
    )
    # a cone of 0.1 rad meets a box that its axis passes by less than a tenth of the distance
    ahead, beside = np.array([[0.0, 0, 1]]), np.array([[0.3, -1, 3.9], [2, 1, 4.1]])
    start = np.zeros((1, 3))
    assert not passes_box(start, ahead, beside, half_angle_rad=0.07).any()
    assert passes_box(start, ahead, beside, half_angle_rad=0.08).all()


def test_pixels_that_see_the_region_are_drawn_more_often() -> None:
    world = PlanarDataset(count=4, side_px=120)
    region = Region((-0.2, -0.1, -0.05, 0.1, 0.3, 0.05))
    sizes = np.full((4, 2), 120)
    rectangles = region_pixels(sizes, world.train_indices, world.rays, region)
    frequency = np.zeros((4, 120, 120), np.int64)
    rows = zip(rectangles.view, rectangles.corner_px, rectangles.size_px, rectangles.frequency, strict=True)
    for view, (x, y), (width, height), times in rows:
        frequency[view, y : y + height, x : x + width] += times
    assert (frequency[0] == FULL_FREQUENCY).all()  # held out: drawn evenly, if at all
    v, y, x = (index.reshape(-1) for index in np.indices(frequency.shape))
    rays = world.rays(v, y, x)
    points = rays.origins_world - rays.directions_world * (
        rays.origins_world[:, 2:] / rays.directions_world[:, 2:]
    )
    inside = region.contains(points).reshape(frequency.shape)
    assert (frequency[inside] == FULL_FREQUENCY).all()
    assert set(np.unique(frequency[1:])) == {OUTSIDE_FREQUENCY, FULL_FREQUENCY}
    assert inside[1:].mean() < (frequency[1:] == FULL_FREQUENCY).mean() < 4 * inside[1:].mean()

    class Partial(PlanarDataset):
        trained_pixels = rectangles

    sampler = pixel_sampler(Partial(count=4, side_px=120), world.train_indices)
    drawn = sampler.pixels(np.random.default_rng(1), 200_000)
    counts = np.zeros(frequency.shape)
    np.add.at(counts, drawn, 1)
    often, seldom = counts[1:][frequency[1:] > 1].mean(), counts[1:][frequency[1:] == 1].mean()
    assert often / seldom == pytest.approx(FULL_FREQUENCY / OUTSIDE_FREQUENCY, rel=0.05)


@pytest.mark.exhaustive
def test_region_gets_the_detail_and_goes_on_after_a_stop(scene: Path, tmp_path: Path) -> None:
    told: list[Event] = []
    region = Region(BOX)
    whole = read_scene(reconstruct(scene, tmp_path / "whole", make_config()))[0]
    run = reconstruct(scene, tmp_path / "region", make_config(BOX), progress=told.append)
    detailed = read_scene(run)[0]
    assert any("The region is seen by" in event.message for event in told if isinstance(event, Noted))
    shares = [float(region.contains(g.means_world).mean()) for g in (whole, detailed)]
    assert shares[1] > 1.25 * shares[0]

    stopped = False

    def stop(event: Event) -> None:
        nonlocal stopped
        stopped |= isinstance(event, CheckpointWritten)

    folder = tmp_path / "stopped"
    with pytest.raises(CancelledError):
        reconstruct(scene, folder, make_config(BOX), progress=stop, should_stop=lambda: stopped)
    with pytest.raises(ConfigError, match="other settings"):
        reconstruct(scene, folder, make_config((*BOX[:5], 0.7)), resume=True)
    reconstruct(scene, folder, make_config(BOX), resume=True)
    assert (folder / "scene.ply").read_bytes() == (run / "scene.ply").read_bytes()


def test_region_is_in_the_coordinates_of_the_files(scene: Path, tmp_path: Path) -> None:
    near = Dataset.open(scene, tmp_path / "cache", region=Region(BOX))
    far = Dataset.open(scene, tmp_path / "cache", origin_world=(10.0, -20.0, 5.0), region=Region(BOX))
    assert near.trained_pixels is not None and far.trained_pixels is not None
    np.testing.assert_array_equal(near.trained_pixels.frequency, far.trained_pixels.frequency)
    np.testing.assert_array_equal(near.trained_pixels.corner_px, far.trained_pixels.corner_px)
    assert (
        near.train_pixel_count
        == far.train_pixel_count
        < Dataset.open(scene, tmp_path / "c").train_pixel_count
    )
    assert far.region == replace(Region(BOX), corners_world=(-10.5, 19.5, -5.2, -9.5, 20.5, -4.2))


def test_regions_that_make_no_sense_are_refused(scene: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidSettingsError, match="smallest x, y, z first"):
        make_config((1, 1, 1, 0, 2, 2))
    with pytest.raises(DatasetError, match="No training photograph sees the region"):
        reconstruct(scene, tmp_path / "nowhere", make_config((500, 500, 500, 501, 501, 501)))
    assert not (tmp_path / "nowhere" / "scene.ply").exists()
    with pytest.raises(ConfigError, match="not trained in blocks with a region"):
        reconstruct(scene, tmp_path / "blocks", make_config(BOX), blocks=BlockRequest(count=2))
