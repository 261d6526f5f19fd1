"""Photographed scenes whose coordinates are large against their size are loaded about a local origin."""

import numpy as np
import pycolmap
import pytest

from octasplat.engine.dataset import Dataset, load_dataset_model
from octasplat.engine.dataset.views_file import read_views, write_views

OFFSETS = {
    "UTM": (512_345.0, 5_403_210.0, 310.0),
    "southern UTM": (334_000.0, 6_250_000.0, 12.0),
    "earth-centred": (4_027_894.0, 306_998.0, 4_919_499.0),
    "far below": (0.0, 0.0, -20_000.0),
}


@pytest.fixture
def make_at(make_scene):
    """Make the scene of the other tests, moved by an offset."""

    def make(root, offset):
        make_scene(root)
        model = pycolmap.Reconstruction(str(root / "sparse/0"))
        model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array(offset)))
        model.write_binary(str(root / "sparse/0"))
        return root

    return make


@pytest.mark.parametrize("offset", OFFSETS.values(), ids=OFFSETS)
def test_large_coordinates_give_the_rays_of_the_scene_at_the_origin(tmp_path, make_at, offset):
    here = Dataset.open(make_at(tmp_path / "here", (0.0, 0.0, 0.0)), tmp_path / "cache_here")
    there = Dataset.open(make_at(tmp_path / "there", offset), tmp_path / "cache_there")
    shift = np.array(offset) - np.array(there.origin_world)
    assert np.abs(shift).max() < 5.0
    for one, two in zip(here.views, there.views, strict=True):
        np.testing.assert_allclose(two.origin_world, one.origin_world + shift, atol=1e-8)
    np.testing.assert_allclose(
        there.view_rays(2).directions_world, here.view_rays(2).directions_world, atol=1e-6
    )
    np.testing.assert_allclose(there.points.xyz_world, here.points.xyz_world + shift, atol=1e-6)
    assert there.extent == pytest.approx(here.extent, rel=1e-6)
    assert any("trained about a local origin" in warning for warning in there.warnings)
    assert here.origin_world == (0.0, 0.0, 0.0)


def test_coordinates_that_are_not_large_are_left_alone(tmp_path, make_at):
    model = load_dataset_model(make_at(tmp_path, (200.0, 0.0, 0.0)))
    assert model.origin_world == (0.0, 0.0, 0.0)
    np.testing.assert_allclose(model.views[0].origin_world, [204.0, 1.2, 0.0], atol=1e-9)
    assert model.warnings == ()


def test_views_file_keeps_the_origin_and_nothing_where_there_is_none(tmp_path, make_at):
    far = Dataset.open(make_at(tmp_path / "far", OFFSETS["UTM"]), tmp_path / "cache").views_record
    near = Dataset.open(make_at(tmp_path / "near", (0.0, 0.0, 0.0)), tmp_path / "cache2").views_record
    write_views(tmp_path / "far.json", far)
    write_views(tmp_path / "near.json", near)
    assert read_views(tmp_path / "far.json") == far
    assert np.abs(np.array(far.origin_world) - OFFSETS["UTM"]).max() < 5.0
    assert all(value.is_integer() for value in far.origin_world)
    assert "origin_world" not in (tmp_path / "near.json").read_text()


def test_records_about_other_origins_are_compared_in_user_coordinates(tmp_path, make_at):
    root = make_at(tmp_path / "far", OFFSETS["UTM"])
    far = Dataset.open(root, tmp_path / "cache").views_record
    origin = tuple(value + 7.0 for value in far.origin_world)
    other = Dataset.open_for_evaluation(
        root, tmp_path / "cache", near_world=0.0, origin_world=origin
    ).views_record
    assert other.origin_world == origin
    assert far.is_of_same_world(other) and not far.is_of_another_world(other)
    moved = other.model_copy(update={"origin_world": far.origin_world})
    assert not far.is_of_same_world(moved) and far.is_of_another_world(moved)


def test_cameras_in_one_place_take_the_size_from_the_points(tmp_path, make_scene):
    place = np.array(OFFSETS["UTM"])
    make_scene(tmp_path, positions=lambda index: place + 1e-6 * index)
    model = load_dataset_model(tmp_path)
    # The points lie around zero, five thousand kilometres from the cameras: nothing is small there.
    assert model.origin_world == (0.0, 0.0, 0.0)
