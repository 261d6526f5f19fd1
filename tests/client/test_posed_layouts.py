"""Which poses of a folder or an archive are taken: the same at every door."""

import io
from pathlib import Path

import pytest

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.scene_layout import lay_out_scene
from octasplat.engine.dataset.model_sources import find_model
from octasplat.engine.poses.photographs import locate_scene, notes_on_files
from octasplat.service.intake.archive import list_archive
from tests.support.zip_builder import ZipMember, build_zip

MODEL = ("cameras.txt", "images.txt", "points3D.txt")
POSED_FOLDERS = {
    "nerfstudio": (("images/a.jpg", "transforms.json", "sparse_pc.ply", "masks/a.jpg.png"), ()),
    "instant-ngp": (("a.jpg", "transforms.json"), ()),
    "Blender": (("train/r_0.png", "test/r_0.png", "transforms_train.json", "transforms_test.json"), ()),
    "Blender without training views": (("test/r_0.png",), ("transforms_test.json",)),
    "RealityScan": (("images/a.jpg", *MODEL), ()),
    "Metashape": (("a.jpg", *MODEL), ()),
    "a part of a model": (("images/a.jpg",), ("cameras.txt", "images.txt")),
    "a splat": (("images/a.jpg",), ("splat.ply",)),
    "dense": (("dense/0/images/a.jpg", "dense/0/sparse/images.bin"), ()),
    "distorted": (("input/a.jpg", "distorted/sparse/0/images.bin"), ()),
    "undistorted beside": (("images/a.jpg", "distorted/sparse/0/images.bin"), ("input/a.jpg",)),
    "in a folder": (("fox/images/a.jpg", "fox/colmap/sparse/0/images.bin", "fox/transforms.json"), ()),
}


@pytest.mark.parametrize("kind", POSED_FOLDERS)
def test_folder_and_archive_take_the_same_poses(kind: str, tmp_path: Path) -> None:
    taken, left_out = POSED_FOLDERS[kind]
    for path in (*taken, *left_out):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(b"x")
    layout = lay_out_scene([*taken, *left_out])
    listing = list_archive(io.BytesIO(build_zip(*(ZipMember(path, b"x") for path in (*taken, *left_out)))))
    assert set(layout.files.values()) == set(taken)
    assert {file.name for file in listing.files} == layout.files.keys()
    assert set(listing.left_out) == set(layout.left_out) == set(left_out)
    assert listing.notes == notes_on_files(locate_scene(tmp_path)) and bool(listing.notes) == bool(left_out)


def test_poses_elsewhere_are_named_where_nothing_fits(tmp_path: Path) -> None:
    for path in ("images/a.jpg", "dense/0/sparse/images.bin", "old/transforms.json"):
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(b"x")
    with pytest.raises(DatasetError, match=r"dense/0/sparse/images\.bin, old/transforms\.json are there"):
        find_model(tmp_path)


@pytest.mark.parametrize("parent", ["sparse", "colmap/sparse", "distorted/sparse"])
def test_model_is_chosen_by_number_or_folder(tmp_path: Path, parent: str) -> None:
    for number in range(3):
        folder = tmp_path / parent / str(number)
        folder.mkdir(parents=True)
        for part in ("cameras", "images", "points3D"):
            (folder / f"{part}.bin").write_bytes((3).to_bytes(8, "little"))
    assert find_model(tmp_path, "2") == find_model(tmp_path, f"{parent}/2") == tmp_path / parent / "2"
    with pytest.raises(DatasetError, match=rf"no model 5; there are {parent}/0, {parent}/1, {parent}/2"):
        find_model(tmp_path, "5")
