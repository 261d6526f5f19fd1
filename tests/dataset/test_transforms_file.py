"""Poses of nerfstudio, instant-ngp and Blender: the same cameras and photographs as from a COLMAP model."""

import json
import math
import shutil
import unicodedata
from collections.abc import Callable, Iterator, KeysView
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.dataset import Dataset, DatasetModel, load_dataset_model
from octasplat.engine.dataset.colmap_reading import load_model
from octasplat.engine.dataset.dataset_part import open_dataset_part, photograph_facts

_COUNT = 5


def _camera(model: str, *params: float) -> pycolmap.Camera:
    return pycolmap.Camera(model=model, width=32, height=24, params=list(params))


@pytest.fixture
def scene(tmp_path: Path, make_scene: Callable[..., Path], coded: Callable[..., np.ndarray]) -> Path:
    """A scene with a COLMAP model."""
    images = [(f"a/frame_{index:03d}.png", 0, coded(32, 24, index)) for index in range(_COUNT)]
    return make_scene(tmp_path / "scene", images=images)


def _frames(model: DatasetModel, prefix: str = "images/", suffix: str = ".png") -> list[dict[str, Any]]:
    """Frames with the poses of a model, from camera to world, y up, looking along -z."""
    frames = []
    for view in model.views:
        matrix = np.eye(4)
        matrix[:3, :3] = view.rotation_cam_from_world.T @ np.diag([1.0, -1.0, -1.0])
        matrix[:3, 3] = view.origin_world
        path = f"{prefix}{view.name.removesuffix('.png')}{suffix}"
        frames.append({"file_path": path, "transform_matrix": matrix.tolist()})
    return frames


def _write(root: Path, frames: list[dict[str, Any]], name: str = "transforms.json", **values: object) -> Path:
    path = root / name
    path.write_text(json.dumps({**values, "frames": frames}))
    return path


def _copy(scene: Path, name: str) -> Path:
    """Return a copy of the scene without its COLMAP model."""
    root = scene.parent / name
    shutil.copytree(scene, root)
    shutil.rmtree(root / "sparse")
    return root


def _is_same(found: DatasetModel, model: DatasetModel) -> None:
    assert len(found.views) == len(model.views) == _COUNT
    for here, there in zip(found.views, model.views, strict=True):
        assert here.image_path.read_bytes() == there.image_path.read_bytes()
        assert np.allclose(here.rotation_cam_from_world, there.rotation_cam_from_world, atol=1e-6)
        assert np.allclose(here.translation_cam_from_world, there.translation_cam_from_world, atol=1e-6)
        pixels = np.array([[3.5, 4.5], [16.0, 12.0], [30.5, 20.5]])
        ways = [
            model_.cameras[view.camera_index].directions_cam(pixels)
            for model_, view in ((found, here), (model, there))
        ]
        assert np.allclose(*ways, atol=1e-6)


_ANGLE_X = 2 * math.atan(16 / 30)
_PINHOLE = {"fl_x": 30.0, "fl_y": 31.0, "cx": 16.0, "cy": 12.0, "w": 32, "h": 24}


@pytest.mark.parametrize(
    ("values", "prefix", "suffix"),
    [
        ({**_PINHOLE, "camera_model": "OPENCV", "k1": 0, "k2": 0, "p1": 0, "p2": 0}, "images/", ".png"),
        (_PINHOLE, "./images/", ".png"),
        (_PINHOLE, "/home/me/fox/images/", ".png"),
        (_PINHOLE, ".\\images\\", ""),
        (_PINHOLE, "", ".JPG"),
        ({"fl_x": 30.0, "fl_y": 31.0}, "images/", ".png"),
        (
            {"camera_angle_x": 2 * math.atan(16 / 30), "camera_angle_y": 2 * math.atan(12 / 31)},
            "images/",
            ".png",
        ),
        ({"camera_model": "PINHOLE", "w": 32.0, "h": 24.0, "fl_x": 30, "fl_y": 31}, "images/", ".png"),
    ],
)
def test_poses_are_those_of_the_colmap_model(
    scene: Path, values: dict[str, object], prefix: str, suffix: str
) -> None:
    model = load_dataset_model(scene)
    root = _copy(scene, "other")
    _write(root, _frames(model, prefix, suffix), **values)
    found = load_dataset_model(root)
    _is_same(found, model)
    assert found.model_folder == root / "transforms.json"


@pytest.mark.parametrize(
    ("camera", "values"),
    [
        (
            _camera("OPENCV", 30, 31, 15, 13, 0.1, -0.02, 0.003, 0.004),
            {"k1": 0.1, "k2": -0.02, "p1": 0.003, "p2": 0.004},
        ),
        (
            _camera("FULL_OPENCV", 30, 31, 15, 13, 0.1, -0.02, 0.003, 0.004, 0.01, 0, 0, 0),
            {"k1": 0.1, "k2": -0.02, "p1": 0.003, "p2": 0.004, "k3": 0.01},
        ),
        (
            _camera("OPENCV_FISHEYE", 30, 31, 15, 13, 0.05, 0.01, 0.002, 0.001),
            {"camera_model": "OPENCV_FISHEYE", "k1": 0.05, "k2": 0.01, "k3": 0.002, "k4": 0.001},
        ),
        (
            _camera("OPENCV_FISHEYE", 30, 31, 15, 13, 0.05, 0.01, 0.002, 0.001),
            {"is_fisheye": True, "k1": 0.05, "k2": 0.01, "k3": 0.002, "k4": 0.001},
        ),
    ],
)
def test_lenses_are_those_of_the_colmap_model(
    tmp_path: Path,
    make_scene: Callable[..., Path],
    coded: Callable[..., np.ndarray],
    camera: pycolmap.Camera,
    values: dict[str, object],
) -> None:
    images = [(f"{index}.png", 0, coded(32, 24, index)) for index in range(_COUNT)]
    scene = make_scene(tmp_path / "scene", cameras=[camera], images=images)
    model = load_dataset_model(scene)
    root = _copy(scene, "other")
    lens = {"fl_x": 30, "fl_y": 31, "cx": 15, "cy": 13, **values}
    _write(root, _frames(model), **lens)
    _is_same(load_dataset_model(root), model)
    # Each frame may have a lens of its own.
    _write(root, [{**frame, **lens} for frame in _frames(model)], fl_x=99, k1=7)
    _is_same(load_dataset_model(root), model)


def test_blender_scenes_have_a_split(scene: Path) -> None:
    model = load_dataset_model(scene)
    root = scene.parent / "blender"
    for view, part in zip(model.views, ("train", "train", "test", "train", "val"), strict=True):
        (root / part).mkdir(parents=True, exist_ok=True)
        shutil.copy(view.image_path, root / part / f"r_{view.name[-5]}.png")
    frames = _frames(model)
    for part, chosen in (("train", (0, 1, 3)), ("test", (2,)), ("val", (4,))):
        rows = [{**frames[i], "file_path": f"./{part}/r_{i}"} for i in chosen]
        _write(root, rows, f"transforms_{part}.json", camera_angle_x=_ANGLE_X)
    found = load_dataset_model(root)
    assert [view.name for view in found.views] == [
        "test/r_2.png",
        "train/r_0.png",
        "train/r_1.png",
        "train/r_3.png",
    ]
    assert found.cameras[0].params == pytest.approx((30, 30, 16, 12))
    dataset = Dataset.open(root, scene.parent / "cache")
    assert [dataset.views[index].name for index in dataset.test_indices] == ["test/r_2.png"]
    told = " ".join(dataset.warnings)
    assert "holds out 1 views, which are measured" in told and "transforms_val.json is not read" in told
    assert "1 images" in told and "val/r_4.png" in told
    every = Dataset.open(root, scene.parent / "cache", split="every", test_every=2)
    assert [every.views[index].name for index in every.test_indices] == ["test/r_2.png", "train/r_1.png"]
    none = Dataset.open(root, scene.parent / "cache", test_every=0)
    assert len(none.test_indices) == 0 and "holds out others, as asked" in " ".join(none.warnings)


def test_a_file_names_the_views_to_hold_out(scene: Path) -> None:
    root = _copy(scene, "other")
    frames = _frames(load_dataset_model(scene))
    names = [frames[3]["file_path"]]
    _write(root, frames, **_PINHOLE, train_filenames=[], test_filenames=names)
    dataset = Dataset.open(root, root / "cache")
    assert [dataset.views[index].name for index in dataset.test_indices] == ["a/frame_003.png"]


@pytest.mark.parametrize("lists_training", [True, False])
def test_views_to_validate_with_are_not_trained_on(scene: Path, lists_training: bool) -> None:
    root = _copy(scene, "other")
    frames = _frames(load_dataset_model(scene))
    names = [frame["file_path"] for frame in frames]
    lists = {"train_filenames": names[:3]} if lists_training else {}
    _write(root, frames, **_PINHOLE, **lists, val_filenames=names[3:4], test_filenames=names[4:])
    dataset = Dataset.open(root, root / "cache")
    assert [dataset.views[index].name for index in dataset.test_indices] == ["a/frame_004.png"]
    assert [dataset.views[index].name for index in dataset.train_indices] == [
        f"a/frame_{index:03d}.png" for index in range(3)
    ]
    assert "1 photographs neither for training nor to be held out" in " ".join(dataset.warnings)
    assert "a/frame_003.png" in " ".join(dataset.warnings)


def test_only_the_views_that_are_listed_for_training_are_trained_on(scene: Path) -> None:
    root = _copy(scene, "other")
    frames = _frames(load_dataset_model(scene))
    listed = [f"./{frame['file_path']}" for frame in frames[:4]]
    _write(root, frames, **_PINHOLE, train_filenames=listed)
    model = load_dataset_model(root)
    assert [view.name for view in model.views] == [f"a/frame_{index:03d}.png" for index in range(4)]
    assert model.held_out is None  # every n-th is held out, as the file says of none


def test_a_file_that_holds_out_none_is_followed_and_told(scene: Path) -> None:
    root = _copy(scene, "other")
    frames = _frames(load_dataset_model(scene))
    names = [frame["file_path"] for frame in frames]
    _write(root, frames, **_PINHOLE, train_filenames=names, val_filenames=[], test_filenames=[])
    dataset = Dataset.open(root, root / "cache")
    assert len(dataset.test_indices) == 0
    assert "holds out no views, so nothing is measured" in " ".join(dataset.warnings)


@pytest.mark.parametrize("colors", ["uchar", "uint8", "float"])
def test_points_are_the_initial_ones(scene: Path, colors: str) -> None:
    root = _copy(scene, "other")
    _write(root, _frames(load_dataset_model(scene)), **_PINHOLE, ply_file_path="sparse_pc.ply")
    rgb = ("0.2 0.4 1", "1 0 0") if colors == "float" else ("51 102 255", "255 0 0")
    rows = [f"{place} {color}" for place, color in zip(("1 2 3", "-4 5.5 6"), rgb, strict=True)]
    header = ["ply", "format ascii 1.0", "element vertex 2", *(f"property float {axis}" for axis in "xyz")]
    header += [f"property {colors} {name}" for name in ("red", "green", "blue")]
    (root / "sparse_pc.ply").write_text("\n".join([*header, "end_header", *rows, ""]))
    points = load_dataset_model(root).points
    assert points.xyz_world.tolist() == [[1, 2, 3], [-4, 5.5, 6]]
    assert np.allclose(points.rgb_srgb, [[0.2, 0.4, 1], [1, 0, 0]])


def test_points_that_are_not_there_are_told(scene: Path) -> None:
    root = _copy(scene, "other")
    _write(root, _frames(load_dataset_model(scene)), **_PINHOLE, ply_file_path="sparse_pc.ply")
    found = load_dataset_model(root)
    assert len(found.points) == 0 and any("sparse_pc.ply, which is not there" in s for s in found.warnings)


def test_the_angle_of_a_photograph_comes_before_the_focal_length_of_all(scene: Path) -> None:
    root = _copy(scene, "other")
    frames = _frames(load_dataset_model(scene))
    frames[1]["camera_angle_x"] = 2 * math.atan(16 / 40)
    _write(root, frames, w=32, h=24, fl_x=30.0, fl_y=31.0)
    found = load_dataset_model(root)
    seen = [
        found.cameras[view.camera_index].directions_cam(np.array([[32.0, 12.0]]))[0] for view in found.views
    ]
    assert [way[0] / way[2] for way in seen[:3]] == pytest.approx([16 / 30, 16 / 40, 16 / 30])


@pytest.mark.parametrize("own", [{"camera_angle_x": 2 * math.atan(16 / 40)}, {"fl_x": 40.0}])
@pytest.mark.parametrize(
    "common", [{"camera_angle_x": 1.0, "camera_angle_y": 0.9}, {"fl_x": 30.0, "fl_y": 31.0}]
)
def test_the_focal_length_of_a_photograph_holds_down_as_well(
    scene: Path, own: dict[str, float], common: dict[str, float]
) -> None:
    root = _copy(scene, "other")
    frames = _frames(load_dataset_model(scene))
    frames[1] |= own
    _write(root, frames, w=32, h=24, **common)
    found = load_dataset_model(root)
    camera = found.cameras[found.views[1].camera_index]
    right, down = camera.directions_cam(np.array([[32.0, 12.0], [16.0, 24.0]]))
    assert (right[0] / right[2], down[1] / down[2]) == pytest.approx((16 / 40, 12 / 40))


def test_masks_are_found_however_their_names_are_spelt(scene: Path, save_image: Callable[..., None]) -> None:
    root = _copy(scene, "other")
    frames = _frames(load_dataset_model(scene))
    save_image(root / "masks" / unicodedata.normalize("NFC", "mä.png"), np.full((24, 32, 1), 255, np.uint8))
    frames[0]["mask_path"] = unicodedata.normalize("NFD", "masks/mä.png")
    _write(root, frames, **_PINHOLE)
    found = load_dataset_model(root)
    assert found.views[0].mask_path is not None and not any("masks that" in told for told in found.warnings)


@pytest.mark.parametrize(
    "record", [{"moved": ["a/frame_003.png"]}, {"lenses": {}}, {"photographs_sha256": "a"}]
)
def test_model_with_changed_poses_keeps_what_the_file_says_besides(
    scene: Path, save_image: Callable[..., None], record: dict[str, Any]
) -> None:
    root, changed = _copy(scene, "other"), scene.parent / "poses"
    frames = _frames(load_dataset_model(scene))
    save_image(root / "masks" / "m1.png", np.full((24, 32, 1), 255, np.uint8))
    frames[1]["mask_path"] = "masks/m1.png"
    path = _write(root, frames[:3], "transforms_train.json", **_PINHOLE)
    _write(root, frames[3:], "transforms_test.json", **_PINHOLE)
    changed.mkdir()
    load_model(path).reconstruction.write_binary(str(changed))
    (changed / "poses.json").write_text(json.dumps(record))
    given, found = load_dataset_model(root), load_dataset_model(root, model_folder=changed)
    assert given.held_out == ("a/frame_003.png", "a/frame_004.png")
    is_given = "photographs_sha256" not in record  # else poses were searched, whatever the file says
    assert found.held_out == (given.held_out if is_given else None)
    assert [view.mask_path for view in found.views] == (
        [view.mask_path for view in given.views] if is_given else [None] * _COUNT
    )
    assert given.views[1].mask_path is not None


def test_part_of_a_scene_needs_no_sizes_of_other_photographs(scene: Path, tmp_path: Path) -> None:
    root = _copy(scene, "other")
    _write(root, _frames(load_dataset_model(scene)), camera_angle_x=_ANGLE_X)
    whole = Dataset.open(root, tmp_path / "cache")
    facts, record = photograph_facts(whole), whole.views_record
    for view in whole.views[2:]:
        view.image_path.write_bytes(b"")  # as where one block needs the first two alone
    part = open_dataset_part(root, tmp_path / "part", np.arange(2), facts, record)
    assert part.cameras == whole.cameras


def test_masks_and_unused_values(scene: Path, save_image: Callable[..., None]) -> None:
    root = _copy(scene, "other")
    frames = _frames(load_dataset_model(scene))
    mask = np.full((24, 32, 1), 255, np.uint8)
    for index, frame in enumerate(frames):
        frame |= {"mask_path": f"masks/m{index}.png", "depth_file_path": f"depths/{index}.png", "blur": 2}
        save_image(root / "masks" / f"m{index}.png", mask)
    frames[4]["mask_path"] = "elsewhere/m4.png"
    _write(root, frames, **_PINHOLE)
    found = load_dataset_model(root)
    assert [view.mask_path and view.mask_path.name for view in found.views] == [
        "m0.png",
        "m1.png",
        "m2.png",
        "m3.png",
        None,
    ]
    told = " ".join(found.warnings)
    assert "1 masks that the transforms file names are neither in masks/" in told
    assert "5 depth maps that the transforms file names are not used; put them into" in told
    assert "values that are not used (blur)" in told


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"camera_model": "THIN_PRISM"}, "camera model THIN_PRISM"),
        ({"fl_x": None, "fl_y": None}, "says no focal length for images/a/frame_000.png"),
        ({"fl_x": -3}, "fl_x: Input should be greater than 0"),
        ({"k4": 0.1}, "k4 of a lens that is no fisheye"),
        ({"frames": []}, "has no frames"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": [[1, 2]]}]}, "frames.0.transform_matrix"),
        (
            {"frames": [{"file_path": "a.png", "transform_matrix": np.diag([2, 2, 2, 1]).tolist()}]},
            "a.png a transform_matrix that is no rigid motion",
        ),
        (
            {"frames": [{"file_path": "a.png", "transform_matrix": np.diag([-1, 1, 1, 1]).tolist()}]},
            "a.png a transform_matrix that is no rigid motion",
        ),
    ],
)
def test_what_makes_no_camera_is_refused_by_name(scene: Path, change: dict[str, object], said: str) -> None:
    root = _copy(scene, "other")
    content = {**_PINHOLE, "frames": _frames(load_dataset_model(scene)), **change}
    (root / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(DatasetError) as refusal:
        load_dataset_model(root)
    assert said in str(refusal.value) and "transforms.json" in str(refusal.value)


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"frames": NaN}', "\ufeff{}"])
def test_a_file_that_is_none_is_refused(scene: Path, text: str) -> None:
    root = _copy(scene, "other")
    (root / "transforms.json").write_text(text)
    with pytest.raises(DatasetError, match=r"transforms\.json is no"):
        load_dataset_model(root)


def test_a_choice_between_models(scene: Path) -> None:
    model = load_dataset_model(scene)
    _write(scene, _frames(model)[:4], **_PINHOLE)
    both = load_dataset_model(scene)
    assert both.model_folder == scene / "sparse/0"
    assert any("transforms.json; only" in sentence for sentence in both.warnings)
    chosen = load_dataset_model(scene, model="transforms.json")
    assert len(chosen.views) == 4 and any("sparse/0 of 5 images" in sentence for sentence in chosen.warnings)
    with pytest.raises(DatasetError, match=r"holds no model sparse/7; there are sparse/0, transforms\.json"):
        load_dataset_model(scene, model="sparse/7")


class _CountedSizes(dict[str, tuple[int, int]]):
    """Sizes of photographs; counts the names that are looked through."""

    seen = 0

    def __iter__(self) -> Iterator[str]:
        for name in super().__iter__():
            self.seen += 1
            yield name

    def keys(self) -> KeysView[str]:
        return KeysView(self)


def test_sizes_are_found_in_one_search_for_all_photographs(tmp_path: Path) -> None:
    names = [f"frame_{index:03d}" for index in range(60)]
    pose = np.eye(4).tolist()
    frames = [{"file_path": f"images/{name}", "transform_matrix": pose} for name in names]
    path = _write(tmp_path, frames, fl_x=30.0)
    sizes = _CountedSizes({f"{name}.PNG": (40 + index, 30) for index, name in enumerate(names)})
    cameras = load_model(path, sizes).reconstruction.cameras
    assert sorted(camera.width for camera in cameras.values()) == [40 + index for index in range(60)]
    assert 0 < sizes.seen <= 10 * len(names)
