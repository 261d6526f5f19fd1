"""All photographs placed at once, those that few points hold taken out again."""

from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from octasplat.engine.poses import global_mapping
from octasplat.engine.poses.global_mapping import map_globally, map_most_globally, take_out_weak_photographs

PHOTOGRAPHS = 8


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """Return a database with matches of photographs around points, and the true model."""
    path = tmp_path_factory.mktemp("capture") / "database.db"
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig = 1, PHOTOGRAPHS
    options.num_points3D = 100
    options.camera_has_prior_focal_length = True
    pycolmap.set_random_seed(1)
    with pycolmap.Database.open(path) as database:
        true = pycolmap.synthesize_dataset(options, database)
        noise = pycolmap.SyntheticNoiseOptions()
        noise.point2D_stddev = 0.3
        pycolmap.synthesize_noise(noise, true, database)
    return path, true


def test_photographs_are_placed_where_they_are(capture: tuple[Path, Any]) -> None:
    database, true = capture
    [model] = map_globally(database, seed=0)
    assert model.num_reg_images() == PHOTOGRAPHS
    names = {image.name: image for image in true.images.values()}
    pairs = [(image, names[image.name]) for image in model.images.values()]
    found = np.array([image.projection_center() for image, _ in pairs])
    centers = np.array([image.projection_center() for _, image in pairs])
    similarity = pycolmap.estimate_sim3d(found, centers)
    moved = np.array([similarity * center for center in found])
    assert np.linalg.norm(moved - centers, axis=1).max() < 0.01 * np.ptp(centers, axis=0).max()
    assert model.compute_mean_reprojection_error() < 0.6
    [again] = map_globally(database, seed=0)
    places = [again.images[image.image_id].projection_center() for image, _ in pairs]
    np.testing.assert_array_equal(places, found)


def test_photographs_that_few_points_hold_lose_their_pose(
    capture: tuple[Path, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = pycolmap.Reconstruction(capture[1])
    weak = model.images[1]
    for index, point in list(enumerate(weak.points2D)):
        if point.has_point3D() and weak.num_points3D > global_mapping.MIN_OBSERVATIONS - 1:
            model.delete_observation(1, index)
    take_out_weak_photographs(model)
    assert 1 not in model.reg_image_ids() and model.num_reg_images() == PHOTOGRAPHS - 1
    monkeypatch.setattr(global_mapping, "MIN_OBSERVATIONS", 1000)
    take_out_weak_photographs(model)
    assert model.num_reg_images() == 0


def test_no_model_of_photographs_without_matches(tmp_path: Path) -> None:
    with pycolmap.Database.open(tmp_path / "empty.db"):
        pass
    assert map_globally(tmp_path / "empty.db", seed=0) == []
    assert map_most_globally(tmp_path / "empty.db", 3, 0) is None
