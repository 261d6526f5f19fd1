"""What of a folder or an archive is a scene: the same at every door."""

import io
from pathlib import Path

import pytest

from octasplat.engine.core.scene_layout import lay_out_scene, left_out_sentences
from octasplat.engine.dataset.colmap_model import find_colmap_model_folder
from octasplat.engine.poses.photographs import left_out_of_search, photographs_in
from octasplat.service.intake.archive import list_archive
from octasplat.workers.client.upload import list_scene_files
from tests.support.zip_builder import ZipMember, build_zip

PHOTOGRAPHS = ("a.jpg", "b.JPG", "c.webp")
FOLDERS = {
    "photographs alone": (PHOTOGRAPHS, PHOTOGRAPHS),
    "card": (
        ("DCIM/100MEDIA/a.JPG", "DCIM/100MEDIA/a.MOV", "DCIM/101MEDIA/a.JPG", "DCIM/101MEDIA/b.JPG"),
        ("100MEDIA/a.JPG", "101MEDIA/a.JPG", "101MEDIA/b.JPG"),
    ),
    "formats": ((*PHOTOGRAPHS, "d.HEIC", "e.avif", "f.dng", "Icon\r", ".DS_Store"), PHOTOGRAPHS),
    "drone": ((*PHOTOGRAPHS, "gcp_list.txt", "flight.MRK"), PHOTOGRAPHS),
    "masks": ((*PHOTOGRAPHS, "masks/a.jpg.png"), PHOTOGRAPHS),
    "run": ((*PHOTOGRAPHS, "run/config.json", "run/events.jsonl", "run/renders/x.png"), PHOTOGRAPHS),
    "input": ((*(f"input/{name}" for name in PHOTOGRAPHS), "other/x.jpg"), PHOTOGRAPHS),
}


@pytest.mark.parametrize("kind", FOLDERS)
def test_folder_archive_and_search_take_the_same_photographs(kind: str, tmp_path: Path) -> None:
    paths, expected = FOLDERS[kind]
    for path in paths:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_bytes(b"x")
    sent, told = list_scene_files(tmp_path)
    listing = list_archive(io.BytesIO(build_zip(*(ZipMember(path, b"x") for path in paths))))
    photographs = {f"images/{name}" for name in expected}
    assert {file.name for file in sent if file.name.startswith("images/")} == photographs
    assert {file.name for file in listing.files} == {file.name for file in sent}
    searched = photographs_in(tmp_path / "input" if kind == "input" else tmp_path)
    assert {Path(name).name for name in searched} == {Path(name).name for name in expected}
    if kind != "run":
        assert left_out_of_search(tmp_path) == told


def test_files_left_out_are_told_by_kind_with_the_way_out() -> None:
    paths = ["images/a.jpg", "sparse/0/project.ini", "images/b.HEIC", "c.jpg", "v.MOV", "transforms.json"]
    layout = lay_out_scene(paths)
    assert layout.files == {"images/a.jpg": "images/a.jpg"} and set(layout.left_out) == set(paths[1:])
    told = left_out_sentences(layout.left_out)
    assert "1 files look like photographs" in told[0] and "images/b.HEIC" in told[0] and "convert" in told[0]
    assert "c.jpg" in told[1] and "v.MOV" in told[2] and "transforms.json" in told[3]
    assert "sparse/0/project.ini" in told[4] and len(told) == 5


def test_old_windows_archive_with_backslashes_only_is_taken() -> None:
    data = build_zip(ZipMember("fox\\images\\a.jpg", b"x"), ZipMember("fox\\images\\b.jpg", b"x"))
    assert [file.name for file in list_archive(io.BytesIO(data)).files] == ["images/a.jpg", "images/b.jpg"]


@pytest.mark.parametrize("parent", ["sparse", "colmap/sparse", "distorted/sparse"])
def test_largest_of_several_models_is_taken(tmp_path: Path, parent: str) -> None:
    for number, count in ((0, 3), (1, 12), (2, 5)):
        folder = tmp_path / parent / str(number)
        folder.mkdir(parents=True)
        for part in ("cameras", "images", "points3D"):
            (folder / f"{part}.bin").write_bytes(count.to_bytes(8, "little"))
    assert find_colmap_model_folder(tmp_path) == tmp_path / parent / "1"


def test_only_model_with_another_number_is_kept_in_an_archive() -> None:
    names = [f"sparse/1/{part}.bin" for part in ("cameras", "images", "points3D")]
    data = build_zip(*(ZipMember(name, b"x") for name in ["images/a.jpg", *names]))
    assert {file.name for file in list_archive(io.BytesIO(data)).files} == {"images/a.jpg", *names}
