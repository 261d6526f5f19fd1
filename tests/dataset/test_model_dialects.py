"""COLMAP models as programs and people leave them: read as meant with a word, or refused by file and line."""

import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset import DatasetModel, load_dataset_model

_MODEL = "sparse/0"


def _edit(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    path.write_text("\n".join(change(path.read_text().split("\n"))))


def _image_lines(lines: list[str]) -> list[int]:
    """Indices of the lines of images, whose next lines are their observations."""
    rows = [index for index, line in enumerate(lines) if line and not line.startswith("#")]
    return rows[::2]


def _is_same(one: DatasetModel, two: DatasetModel, *, observations: bool = True) -> None:
    assert [view.name for view in one.views] == [view.name for view in two.views]
    assert one.cameras == two.cameras
    for here, there in zip(one.views, two.views, strict=True):
        assert np.allclose(here.rotation_cam_from_world, there.rotation_cam_from_world, atol=1e-12)
        assert np.allclose(here.translation_cam_from_world, there.translation_cam_from_world, atol=1e-12)
    assert np.array_equal(one.points.xyz_world, two.points.xyz_world)
    assert np.array_equal(one.points.rgb_srgb, two.points.rgb_srgb)
    if observations:
        assert np.array_equal(one.points.track_lengths, two.points.track_lengths)
        assert np.array_equal(one.observations.point, two.observations.point)


@pytest.fixture
def scene(tmp_path: Path, make_scene: Callable[..., Path]) -> Path:
    """A scene with a text model that is fine."""
    return make_scene(tmp_path / "scene", text=True)


def test_a_fine_model_is_read_without_a_word(scene: Path) -> None:
    assert load_dataset_model(scene).warnings == ()


@pytest.mark.parametrize("letters", ["my view {}.png", "A-DJI  {} (1).png", "r e p o r t {}.png"])
def test_names_with_spaces_are_whole(
    tmp_path: Path, make_scene: Callable[..., Path], coded: Callable[..., np.ndarray], letters: str
) -> None:
    images = [(letters.format(index), 0, coded(32, 24, index)) for index in range(4)]
    text = make_scene(tmp_path / "text", images=images, text=True)
    binary = make_scene(tmp_path / "binary", images=images)
    found = load_dataset_model(text)
    assert sorted(view.name for view in found.views) == sorted(name for name, _, _ in images)
    _is_same(found, load_dataset_model(binary))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
@pytest.mark.parametrize("parts", [("cameras",), ("images", "points3D"), ("cameras", "images", "points3D")])
def test_files_of_windows_programs_are_read(scene: Path, encoding: str, parts: tuple[str, ...]) -> None:
    before = load_dataset_model(scene)
    for part in parts:
        path = scene / _MODEL / f"{part}.txt"
        path.write_bytes(path.read_text().replace("\n", "\r\n").encode(encoding))
    after = load_dataset_model(scene)
    _is_same(after, before)
    what = "byte order mark" if encoding == "utf-8-sig" else "UTF-16"
    for part in parts:
        assert any(f"{part}.txt" in sentence and what in sentence for sentence in after.warnings)


def test_other_encodings_are_refused_by_line(scene: Path) -> None:
    path = scene / _MODEL / "images.txt"
    lines = path.read_text().replace("view_1", "my view_ä").split("\n")
    number = next(index for index, line in enumerate(lines, start=1) if "ä" in line)
    path.write_bytes("\n".join(lines).encode("latin-1"))
    with pytest.raises(DatasetError, match=rf"images\.txt is neither UTF-8 nor UTF-16 \(line {number}\)"):
        load_dataset_model(scene)


@pytest.mark.parametrize("kept", ["blank", "none", "last", "second"])
def test_images_without_lines_of_observations_are_all_taken(scene: Path, kept: str) -> None:
    before = load_dataset_model(scene)

    def change(lines: list[str]) -> list[str]:
        images = _image_lines(lines)
        if kept == "blank":
            return [
                line for index, line in enumerate(lines) if index - 1 not in images or index == len(lines)
            ]
        gone = {"none": images, "last": images[-1:], "second": images[1:2]}[kept]
        return [line for index, line in enumerate(lines) if index - 1 not in gone]

    _edit(scene / _MODEL / "images.txt", change)
    after = load_dataset_model(scene)
    _is_same(after, before, observations=False)
    assert len(after.views) == 4
    missing = {"blank": 4, "none": 4, "last": 1, "second": 1}[kept]
    assert any(f"observations after {missing} of 4 images" in sentence for sentence in after.warnings)


@pytest.mark.parametrize("text", [True, False])
def test_a_part_of_the_images_keeps_all_points(
    tmp_path: Path, make_scene: Callable[..., Path], text: bool
) -> None:
    root = make_scene(tmp_path / "scene", text=text, with_rigs=False)
    whole = load_dataset_model(root)
    path = root / _MODEL / ("images.txt" if text else "images.bin")
    if text:
        _edit(path, lambda lines: [*lines[: _image_lines(lines)[0]], *lines[_image_lines(lines)[1] :]])
    else:
        data = path.read_bytes()
        first = 8 + 64 + len(b"view_0.png\0") + 8 + 24 * 20
        path.write_bytes(struct.pack("<Q", 3) + data[first:])
    part = load_dataset_model(root)
    assert [view.name for view in part.views] == ["view_1.png", "view_2.png", "view_3.png"]
    assert np.array_equal(part.points.xyz_world, whole.points.xyz_world)
    assert any("name 20 observations that its images do not have" in sentence for sentence in part.warnings)


def test_short_parameters_are_counted(scene: Path) -> None:
    path = scene / _MODEL / "cameras.txt"
    _edit(path, lambda lines: [line.replace("PINHOLE", "FULL_OPENCV") for line in lines])
    with pytest.raises(
        DatasetError,
        match=r"cameras\.txt has 4 parameters for camera 1, and FULL_OPENCV needs 12 \(line \d+\)",
    ):
        load_dataset_model(scene)


@pytest.mark.parametrize("name", ["pinhole", "BROWN", "INVALID"])
def test_unknown_camera_models_are_named(scene: Path, name: str) -> None:
    path = scene / _MODEL / "cameras.txt"
    _edit(path, lambda lines: [line.replace(" PINHOLE ", f" {name} ") for line in lines])
    with pytest.raises(DatasetError, match=rf"camera model {name}.* \(line \d+\)"):
        load_dataset_model(scene)


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_lines_that_come_twice_count_once(scene: Path, part: str) -> None:
    before = load_dataset_model(scene)
    length = 2 if part == "images" else 1

    def change(lines: list[str]) -> list[str]:
        first = _image_lines(lines)[0]
        return [*lines[: first + length], *lines[first : first + length], *lines[first + length :]]

    _edit(scene / _MODEL / f"{part}.txt", change)
    after = load_dataset_model(scene)
    _is_same(after, before)
    assert any(f"{part}.txt has 1 lines twice" in sentence for sentence in after.warnings)


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_ids_of_two_meanings_are_refused_by_line(scene: Path, part: str) -> None:
    def change(lines: list[str]) -> list[str]:
        first = _image_lines(lines)[0]
        other = lines[first].split(" ")
        other[-1 if part == "cameras" else 2] = "0.25"
        after = [lines[first + 1]] if part == "images" else []
        return [*lines[: first + 1 + len(after)], " ".join(other), *after, *lines[first + 1 + len(after) :]]

    _edit(scene / _MODEL / f"{part}.txt", change)
    with pytest.raises(DatasetError, match=rf"{part}\.txt has \w+ 1 twice \(lines \d+ and \d+\)"):
        load_dataset_model(scene)


@pytest.mark.parametrize(
    ("part", "old", "new", "said"),
    [
        (
            "cameras",
            "30",
            "3,5",
            r"cameras\.txt holds '3,5' where a finite number belongs in camera 1 \(line",
        ),
        ("images", "1 2 1 ", "1 2 1.5 ", r"images\.txt holds neither an image nor observations .*\(line"),
        ("points3D", "255", "red", r"points3D\.txt holds no point .*\(line"),
    ],
)
def test_lines_that_are_nothing_are_refused_by_line(
    scene: Path, part: str, old: str, new: str, said: str
) -> None:
    def change(lines: list[str]) -> list[str]:
        rows = [index for index, line in enumerate(lines) if old in line and not line.startswith("#")]
        lines[rows[0]] = lines[rows[0]].replace(old, new, 1)
        return lines

    _edit(scene / _MODEL / f"{part}.txt", change)
    with pytest.raises(DatasetError, match=said):
        load_dataset_model(scene)


def test_images_of_no_camera_are_refused(scene: Path) -> None:
    path = scene / _MODEL / "cameras.txt"
    _edit(path, lambda lines: [line for line in lines if not line.startswith("1 ")])
    with pytest.raises(DatasetError, match=r"names camera 1 for view_0\.png, which is not in cameras\.txt"):
        load_dataset_model(scene)


def test_a_name_that_comes_twice_is_refused(tmp_path: Path, make_scene: Callable[..., Path]) -> None:
    root = make_scene(tmp_path / "scene")
    model = pycolmap.Reconstruction(str(root / _MODEL))
    model.images[2].name = "view_0.png"
    shutil.rmtree(root / _MODEL)
    (root / _MODEL).mkdir()
    model.write_binary(str(root / _MODEL))
    with pytest.raises(DatasetError, match=r"has 1 images twice \(view_0\.png\)"):
        load_dataset_model(root)
