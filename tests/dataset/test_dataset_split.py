import json

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError, DatasetError
from octasplat.engine.dataset import SparsePoints, scene_extent, split_views, write_held_out

NAMES = [f"{i:02d}.jpg" for i in range(18)]


def points(xyz) -> SparsePoints:
    xyz = np.asarray(xyz, dtype=np.float32).reshape(-1, 3)
    n = len(xyz)
    return SparsePoints(
        xyz,
        np.zeros((n, 3), np.float32),
        np.full(n, 2, np.int32),
        np.full(n, -1, dtype=np.float32),
        np.arange(n),
    )


def test_default_split_holds_out_every_eighth_view():
    train, test = split_views(NAMES)
    assert test.tolist() == [0, 8, 16]
    assert sorted([*train, *test]) == list(range(18))
    assert train.dtype == test.dtype == np.int64


def test_split_test_every_zero_holds_out_none():
    train, test = split_views(NAMES, test_every=0)
    assert len(train) == 18
    assert test.tolist() == []


def test_explicit_test_names_override_rule():
    assert split_views(NAMES, held_out=("17.jpg", "03.jpg"))[1].tolist() == [3, 17]
    assert split_views(NAMES, held_out=())[1].tolist() == []


def test_unknown_names_are_refused():
    with pytest.raises(DatasetError, match=r"99\.jpg"):
        split_views(NAMES, held_out=("99.jpg", "03.jpg"))


def test_split_without_training_views_is_refused():
    with pytest.raises(DatasetError, match="held out"):
        split_views(NAMES, test_every=1)
    with pytest.raises(ConfigError, match="-1"):
        split_views(NAMES, test_every=-1)


def test_held_out_names_are_written(tmp_path):
    write_held_out(tmp_path / "out" / "held_out.json", ["b/ä.jpg", "c.jpg"])
    assert json.loads((tmp_path / "out" / "held_out.json").read_text()) == ["b/ä.jpg", "c.jpg"]


def test_extent_is_the_radius_of_the_cameras():
    angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    ring = np.stack([3 * np.cos(angle) + 7, 3 * np.sin(angle), np.zeros(20)], axis=1)
    assert scene_extent(ring, points([])) == pytest.approx(3.3)
    stray = np.concatenate([ring, [[1e6, 0, 0]]])
    assert scene_extent(stray, points([])) == pytest.approx(3.3)


def test_extent_of_cameras_in_one_place_comes_from_the_points():
    place = np.full((5, 3), 2.0)
    assert scene_extent(place, points([[2, 2, 6], [2, 6, 2]])) == pytest.approx(4.0)
    assert scene_extent(place, points([])) == 1.0
    assert scene_extent(place + np.arange(5)[:, None] * 1e-9, points([[2, 2, 6]])) == pytest.approx(4.0)
