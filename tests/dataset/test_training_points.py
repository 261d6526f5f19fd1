"""Training begins with what training views know, and sees what is near along however long a path."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.model import Observations, SparsePoints
from octasplat.engine.dataset.training_points import is_observed_by

SPACING, AWAY, VIEWS = 5.0, 2.0, 60


@pytest.fixture
def wall(tmp_path: Path, save_image: Callable[..., None]) -> Path:
    """Photographs in a line along a wall; point k is shown by photographs k and k + 1."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=16, height=12, params=[14.0, 14.0, 8.0, 6.0])
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    for index in range(VIEWS):
        image = pycolmap.Image(name=f"{index:03d}.png", camera_id=1, image_id=index + 1)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([8.0, 6.0])) for _ in range(40)])
        turn = pycolmap.Rotation3d(np.eye(3))
        model.add_image_with_trivial_frame(
            image, pycolmap.Rigid3d(turn, np.array([-index * SPACING, 0.0, 0.0]))
        )
        save_image(tmp_path / "images" / image.name, np.full((12, 16, 3), 90, np.uint8))
    for index in range(VIEWS - 1):
        for number in range(20):
            track = pycolmap.Track()
            track.add_element(index + 1, number)
            track.add_element(index + 2, 20 + number)
            place = np.array([index * SPACING + 0.1 * number, 0.0, AWAY])
            model.add_point3D(place, track, np.array([9, 9, 9], dtype=np.uint8))
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    model.write_binary(str(tmp_path / "sparse" / "0"))
    return tmp_path


def test_points_depending_on_test_views_are_dropped(wall: Path, tmp_path: Path) -> None:
    dataset = Dataset.open(wall, tmp_path / "cache", test_every=8)
    shown_by = np.rint(dataset.points.xyz_world[:, 0] // SPACING).astype(int)
    held_out = set(dataset.test_indices.tolist())
    expected = [k for k in range(VIEWS - 1) if not {k, k + 1} & held_out]
    assert sorted(set(shown_by.tolist())) == expected
    assert len(dataset.points) == 20 * len(expected)
    everything = Dataset.open(wall, tmp_path / "cache", test_every=0)
    assert len(everything.points) == 20 * (VIEWS - 1)


def test_near_distance_of_long_path(wall: Path, tmp_path: Path) -> None:
    dataset = Dataset.open(wall, tmp_path / "cache", near=0.01)
    assert 0.01 * dataset.extent > 0.8 * AWAY  # which would cut the wall off
    assert dataset.near_world == pytest.approx(0.25 * AWAY, rel=0.15)
    short = Dataset.open(wall, tmp_path / "cache", near=1e-4)
    assert short.near_world == 1e-4 * short.extent


def test_track_counts_each_photograph_once() -> None:
    nothing = np.zeros((2, 3), np.float32)
    points = SparsePoints(
        nothing, nothing, np.full(2, 3, np.int32), np.zeros(2, np.float32), np.array([4, 7])
    )
    views, ids = np.array([0, 0, 5, 0, 1]), np.array([4, 4, 4, 7, 7])  # view 5 is held out
    known = is_observed_by(np.array([0, 1]), points, Observations(views, ids, np.zeros((5, 2))))
    assert known.tolist() == [False, True]
