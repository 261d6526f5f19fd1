"""Depth maps beside photographs: found by name, read in any unit, and turned into distances along rays."""

import json
import shutil
import time
import unicodedata
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.scene_layout import lay_out_scene
from octasplat.engine.dataset import Dataset, depth_maps, load_dataset_model
from octasplat.engine.dataset.depth_maps import (
    depth_maps_digest,
    find_depth_maps,
    open_depth_maps,
    read_depth_map,
)
from octasplat.engine.dataset.photograph_files import image_folder, photographs_below
from tests.support.tiny_dataset import make_tiny_dataset

_FORMATS = {"float32": "float", "uint16": "uint16", "int16": "int16", "uint8": "uint8"}


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory)


def true_depth(scene: Path, stem: str) -> np.ndarray:
    """z of each pixel in metres; 0 where there is nothing."""
    image = oiio.ImageInput.open(str(scene / "ground_truth" / "depth" / f"{stem}.exr"))
    depth = np.asarray(image.read_image("float"))[..., 0]
    image.close()
    return depth


def write_map(path: Path, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    spec = oiio.ImageSpec(values.shape[1], values.shape[0], 1, _FORMATS[values.dtype.name])
    out = oiio.ImageOutput.create(str(path))
    out.open(str(path), spec)
    out.write_image(np.ascontiguousarray(values[..., None]))
    out.close()


@pytest.fixture
def with_maps(generated: Path, tmp_path: Path) -> Callable[..., Path]:
    def make(
        name: str = "depths/{}.exr", *, change: Callable[[np.ndarray], np.ndarray] | None = None
    ) -> Path:
        scene = tmp_path / f"scene{len(list(tmp_path.iterdir()))}"
        shutil.copytree(generated, scene)
        for photograph in sorted((scene / "images").iterdir()):
            depth = true_depth(scene, photograph.stem)
            write_map(scene / name.format(photograph.stem), depth if change is None else change(depth))
        return scene

    return make


def all_pixels(dataset: Dataset, view: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    width, height = dataset.views[view].width_px, dataset.views[view].height_px
    y, x = np.divmod(np.arange(width * height), width)
    return np.full(len(y), view), y, x


def as_millimetres(depth: np.ndarray) -> np.ndarray:
    return np.rint(1000 * depth).astype(np.uint16)


@pytest.mark.parametrize(
    ("name", "change", "tolerance"),
    # the unit is found by the sparse points, to the accuracy of these
    [
        ("depths/{}.exr", None, 2e-3),
        ("depths/{}.png", as_millimetres, 2e-3),
        ("depth/{}.png.tif", None, 2e-3),
        ("depths/{}.exr", lambda depth: (depth * 39.37).astype(np.float32), 2e-3),
        ("depths/{}.png", lambda depth: np.rint(5000 * depth).astype(np.uint16), 3e-3),
    ],
    ids=["metres", "millimetres", "TIFF in depth/", "inches", "a 5000th of a metre"],
)
def test_distances_are_those_of_the_surface(
    with_maps: Callable[..., Path], tmp_path: Path, name: str, change: object, tolerance: float
) -> None:
    scene = with_maps(name, change=change)
    dataset = Dataset.open(scene, tmp_path / "cache")
    assert dataset.has_known_distances
    view = 3
    pixels = all_pixels(dataset, view)
    depth = true_depth(scene, Path(dataset.views[view].name).stem).reshape(-1)
    rays = dataset.rays(*pixels)
    # By the definition of z: the point on the ray at that distance has this depth in the camera frame.
    places = rays.origins_world + dataset.known_distances(*pixels)[:, None] * rays.directions_world
    at = dataset.views[view]
    z = (places @ at.rotation_cam_from_world.T + at.translation_cam_from_world)[:, 2]
    shown = depth > 0
    assert shown.sum() > 500
    np.testing.assert_allclose(z[shown], depth[shown], rtol=tolerance)
    assert not dataset.known_distances(*pixels)[~shown].any()
    assert any("depth maps of 8 photographs are used" in warning for warning in dataset.warnings)


def test_smaller_maps_and_photographs_meet_at_pixel_centres(
    with_maps: Callable[..., Path], tmp_path: Path
) -> None:
    scene = with_maps(change=lambda depth: depth[::2, ::2])  # 32 x 24 values of 64 x 48 pixels
    dataset = Dataset.open(scene, tmp_path / "cache", max_side=16, depth_unit=1.0)
    small = true_depth(scene, Path(dataset.views[0].name).stem)[::2, ::2]
    pixels = all_pixels(dataset, 0)
    along = dataset.rays(*pixels).directions_world @ dataset.views[0].rotation_cam_from_world[2]
    # the photograph's pixel 0 of 16 spans the map's 0 and 1 of 32, in the middle of which 1 begins
    expected = small[1::2, 1::2].reshape(-1)
    np.testing.assert_allclose(dataset.known_distances(*pixels) * along, expected, atol=1e-5)


def test_a_stated_unit_is_taken_as_it_is(with_maps: Callable[..., Path], tmp_path: Path) -> None:
    scene = with_maps(change=as_millimetres, name="depths/{}.png")
    stated = Dataset.open(scene, tmp_path / "cache", depth_unit=0.002)
    fitted = Dataset.open(scene, tmp_path / "cache")
    pixels = all_pixels(stated, 1)
    known = fitted.known_distances(*pixels) > 0
    ratio = stated.known_distances(*pixels)[known] / fitted.known_distances(*pixels)[known]
    np.testing.assert_allclose(ratio, 2.0, rtol=2e-3)
    assert not any("depth map" in warning for warning in stated.warnings)


def test_photographs_without_a_map_are_named_and_know_nothing(
    with_maps: Callable[..., Path], tmp_path: Path
) -> None:
    scene = with_maps()
    dropped = min((scene / "depths").iterdir())
    dropped.unlink()
    dataset = Dataset.open(scene, tmp_path / "cache")
    assert any(f"1 photographs have no depth map ({dropped.stem}" in text for text in dataset.warnings)
    assert not dataset.known_distances(*all_pixels(dataset, 0)).any()
    assert dataset.known_distances(*all_pixels(dataset, 1)).any()


def test_other_maps_make_another_record(with_maps: Callable[..., Path], tmp_path: Path) -> None:
    plain, scene = with_maps("elsewhere/{}.exr"), with_maps()
    before = Dataset.open(plain, tmp_path / "plain").views_record
    assert "depths_sha256" not in before.model_dump_json()
    record = Dataset.open(scene, tmp_path / "cache").views_record
    assert before.difference(record) == "other depth maps or another known geometry"
    one = min((scene / "depths").iterdir())
    write_map(one, true_depth(scene, one.stem) * np.float32(1.01))
    changed = Dataset.open(scene, tmp_path / "cache")
    assert record.difference(changed.views_record) == "other depth maps or another known geometry"
    again = Dataset.open(scene, tmp_path / "fresh")
    pixels = all_pixels(changed, 0)
    np.testing.assert_array_equal(changed.known_distances(*pixels), again.known_distances(*pixels))


def test_transforms_file_names_its_depth_maps(generated: Path, tmp_path: Path) -> None:
    source = Dataset.open(generated, tmp_path / "source")
    scene = tmp_path / "scene"
    shutil.copytree(generated / "images", scene / "images")
    frames = []
    for number, view in enumerate(source.views):
        pose = np.eye(4)
        pose[:3, :3] = view.rotation_cam_from_world.T @ np.diag([1.0, -1.0, -1.0])
        pose[:3, 3] = view.origin_world
        write_map(scene / "depth" / f"{number}.exr", true_depth(generated, Path(view.name).stem))
        frames.append(
            {
                "file_path": f"images/{view.name}",
                "depth_file_path": f"depth/{number}.exr",
                "transform_matrix": pose.tolist(),
            }
        )
    camera = source.cameras[0]
    lens = dict(zip(("fl_x", "fl_y", "cx", "cy"), camera.params, strict=True))
    size = {"w": camera.width_px, "h": camera.height_px}
    (scene / "transforms.json").write_text(json.dumps({**lens, **size, "frames": frames}))
    dataset = Dataset.open(scene, tmp_path / "cache")
    # without sparse points the unit is that of the file
    assert any("taken in metres" in warning for warning in dataset.warnings)
    pixels = all_pixels(dataset, 2)
    along = dataset.rays(*pixels).directions_world @ dataset.views[2].rotation_cam_from_world[2]
    depth = true_depth(generated, Path(dataset.views[2].name).stem).reshape(-1)
    np.testing.assert_allclose(dataset.known_distances(*pixels) * along, depth, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda depth: (255 * depth / depth.max()).astype(np.uint8), "8 bits a pixel.*16-bit PNG"),
        (lambda depth: depth[:, :40], "is 40x48 but its photograph is 64x48"),
        (lambda depth: np.where(depth > 0, 1 / np.maximum(depth, 1e-3), 0).astype(np.float32), "do not fit"),
    ],
    ids=["8 bits", "other sides", "inverse depths"],
)
def test_maps_that_hold_no_depths_of_the_photographs_are_refused(
    with_maps: Callable[..., Path], tmp_path: Path, change: object, message: str
) -> None:
    scene = with_maps("depths/{}.png" if "8 bits" in message else "depths/{}.exr", change=change)
    with pytest.raises(DatasetError, match=message):
        Dataset.open(scene, tmp_path / "cache")


def test_a_scene_keeps_its_depth_maps_apart_from_photographs() -> None:
    names = ["s/images/a.jpg", "s/depths/a.png", "s/sparse/0/cameras.bin"]
    assert lay_out_scene(names).files == {name.removeprefix("s/"): name for name in names}
    bare = lay_out_scene(["a.jpg", "b.jpg", "depth/a.png"])
    assert bare.files == {"images/a.jpg": "a.jpg", "images/b.jpg": "b.jpg", "depth/a.png": "depth/a.png"}


def test_maps_do_not_pile_up_in_memory(
    with_maps: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, waiting, most = with_maps(), [0], [0]
    check_sides = depth_maps._check_sides

    def read(path: Path) -> tuple[np.ndarray, bool]:
        waiting[0] += 1
        return read_depth_map(path)

    def check(*args: object) -> None:
        time.sleep(0.05)  # a slow disk
        most[0] = max(most[0], waiting[0])
        waiting[0] -= 1
        check_sides(*args)

    monkeypatch.setattr(depth_maps, "read_depth_map", read)
    monkeypatch.setattr(depth_maps, "_check_sides", check)
    model = load_dataset_model(scene)
    assert len(model.views) == 8
    open_depth_maps(model, tmp_path / "cache", "digest", threads=1)
    assert 0 < most[0] <= 3


def test_cached_maps_are_those_of_the_views(with_maps: Callable[..., Path], tmp_path: Path) -> None:
    scene = with_maps()
    min((scene / "depths").iterdir()).unlink()
    model = load_dataset_model(scene)
    fewer = replace(model, views=model.views[1:])  # without the photograph that has no map
    digest = depth_maps_digest(model)
    assert digest is not None and digest == depth_maps_digest(fewer)
    open_depth_maps(model, tmp_path / "cache", digest)
    found = open_depth_maps(fewer, tmp_path / "cache", digest)
    fresh = open_depth_maps(fewer, tmp_path / "fresh", digest)
    np.testing.assert_array_equal(found.sizes_px, fresh.sizes_px)
    np.testing.assert_array_equal(found.offsets, fresh.offsets)


@pytest.mark.parametrize("kind", [np.uint16, np.int16])
def test_integers_are_read_as_they_are_stored(tmp_path: Path, kind: type[np.integer]) -> None:
    write_map(tmp_path / "a.tif", np.array([[0, 1500, 30000]], kind))
    depth, is_integer = read_depth_map(tmp_path / "a.tif")
    assert is_integer
    np.testing.assert_array_equal(depth, [[0, 1500, 30000]])


def test_what_a_renderer_writes_for_nothing_is_unknown(tmp_path: Path) -> None:
    write_map(tmp_path / "a.exr", np.array([[1e10, np.inf, np.nan, -1, 0, 2.5]], np.float32))
    np.testing.assert_array_equal(read_depth_map(tmp_path / "a.exr")[0], [[0, 0, 0, 0, 0, 2.5]])


def test_maps_belong_to_the_photographs_that_name_them() -> None:
    on_disk = {name: Path(name) for name in ("1.png", "left/1.png", "right/1.png", "right/d2.png")}
    named = {
        "left/1.jpg": "./depths/left/1.png", "right/1.jpg": "C:\\s\\depth\\right\\1.png",
        "2.jpg": "maps/right/d2.png", "3.jpg": "maps/1.png", "4.jpg": "depths/gone/1.png",
    }  # fmt: skip
    found = find_depth_maps(list(named), on_disk, named)
    assert [None if path is None else path.as_posix() for path in found] == [
        "left/1.png", "right/1.png", "right/d2.png", "1.png", None,
    ]  # fmt: skip


def test_names_are_compared_in_one_unicode_form() -> None:
    composed, apart = (unicodedata.normalize(form, "Höhe") for form in ("NFC", "NFD"))
    path = Path(f"{composed}.png")
    assert find_depth_maps([f"{apart}.jpg"], {path.name: path}, {}) == (path,)
    assert find_depth_maps(["a.jpg"], {path.name: path}, {"a.jpg": f"depths/{apart}.png"}) == (path,)


def test_photographs_below_images_are_no_depth_maps(generated: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    for photograph in (generated / "images").iterdir():
        (scene / "images" / "depth").mkdir(parents=True, exist_ok=True)
        shutil.copy(photograph, scene / "images" / "depth" / photograph.name)
    names = {path.relative_to(scene).as_posix() for path in scene.rglob("*.*")}
    assert set(lay_out_scene(sorted(names)).files) == names
    assert {f"images/{name}" for name in photographs_below(image_folder(scene))} == names
