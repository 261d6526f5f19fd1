"""3D Tiles: the tree, what its tiles hold, and where they stand."""

import errno
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octasplat.engine.core.earth_frame import geocentric_from_metres
from octasplat.engine.core.errors import DiskFullError, SceneFileError
from octasplat.engine.core.georeference import WGS84, Georeference, matrix_rows
from octasplat.engine.files import (
    ExportOptions,
    dropped_on_export,
    export_scene,
    importer_for,
    read_scene,
    tiles_3d,
)
from octasplat.engine.files.glb_container import GlbFile
from octasplat.engine.gaussians.flattening import GaussianCloud
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.scene_metadata import SceneMetadata
from tests.support.cloud_difference import difference
from tests.support.shell_scene import shell_scene

Tile = dict[str, Any]


@pytest.fixture(autouse=True)
def small_tiles(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiles_3d, "FEWEST_IN_ROOT", 40)


@pytest.fixture
def scene() -> FlatGaussians:
    """Four levels: 360, 180, 90 and 45 Gaussians, two of them far away."""
    shell = shell_scene(360)
    random = np.random.default_rng(3)
    means = shell.means_world.copy()
    means[:2] = [[40.0, 3.0, -2.0], [-55.0, 20.0, 1.0]]
    harmonics = random.uniform(-0.6, 0.6, (360, 15, 3)).astype(np.float32)
    return replace(shell, means_world=means, sh=np.concatenate([shell.sh, harmonics], axis=1))


def tileset_of(path: Path) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(path.read_text())
    return document


def walk(tile: Tile, depth: int = 0) -> Iterator[tuple[Tile, int]]:
    yield tile, depth
    for child in tile.get("children", []):
        yield from walk(child, depth + 1)


def corners(tile: Tile) -> tuple[np.ndarray, np.ndarray]:
    box = np.array(tile["boundingVolume"]["box"])
    half = box[3:].reshape(3, 3)
    np.testing.assert_array_equal(half, np.diag(np.diag(half)))
    return box[:3] - np.diag(half), box[:3] + np.diag(half)


def cloud_of(index: Path, tile: Tile) -> GaussianCloud:
    path = index.parent / tile["content"]["uri"]
    return importer_for(path).read(path)


def in_tile_frame(means: np.ndarray) -> np.ndarray:
    """Tiles are z up, our scenes y down and z forward."""
    return means.astype(np.float64)[:, [0, 2, 1]] * (1, 1, -1)


@pytest.mark.parametrize("log_scale", [88.7, 89.0])
def test_gaussians_beyond_float32_are_refused_and_large_ones_written(
    scene: FlatGaussians, tmp_path: Path, log_scale: float
) -> None:
    scene.log_scales[3:9] = log_scale
    if log_scale > 88.72:
        with pytest.raises(SceneFileError, match=r"tileset\.json: not written, .* too large for float32"):
            export_scene(scene, tmp_path / "tileset.json")
        assert list(tmp_path.iterdir()) == []
        return
    export_scene(scene, tmp_path / "tileset.json")
    assert len(tileset_of(tmp_path / "tileset.json")["root"]["children"]) == 2


def test_index_is_as_the_standard_asks(scene: FlatGaussians, tmp_path: Path) -> None:
    index, *contents = export_scene(scene, tmp_path / "out" / "tileset.json")
    document = tileset_of(index)
    assert document["asset"]["version"] == "1.1"
    gltf = document["extensions"]["3DTILES_content_gltf"]
    needed = ["KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2"]
    assert gltf["extensionsRequired"] == gltf["extensionsUsed"] == needed
    assert document["extensionsUsed"] == ["3DTILES_content_gltf"]
    root = document["root"]
    assert root["refine"] == "REPLACE" and "transform" not in root
    assert document["geometricError"] > root["geometricError"]
    named = [tile["content"]["uri"] for tile, _ in walk(root)]
    assert sorted(named) == sorted(path.relative_to(index.parent).as_posix() for path in contents)
    assert [sum(at == depth for _, at in walk(root)) for depth in range(5)] == [1, 2, 4, 8, 0]


def test_tree_is_nested_and_refines(scene: FlatGaussians, tmp_path: Path) -> None:
    index, *_ = export_scene(scene, tmp_path / "out" / "tileset.json")
    counts: dict[int, list[int]] = {}
    for tile, depth in walk(tileset_of(index)["root"]):
        low, high = corners(tile)
        means = in_tile_frame(cloud_of(index, tile).means_world)
        assert (means >= low).all() and (means <= high).all()
        counts.setdefault(depth, []).append(len(means))
        assert bool(tile.get("children")) == (depth < 3) == (tile["geometricError"] > 0)
        for child in tile.get("children", []):
            assert child["geometricError"] < tile["geometricError"]
            inner_low, inner_high = corners(child)
            assert (inner_low >= low - 1e-9).all() and (inner_high <= high + 1e-9).all()
    assert [sum(found) for _, found in sorted(counts.items())] == [45, 90, 180, 360]
    assert set(counts[3]) == {45}


def test_leaves_hold_each_gaussian_once(scene: FlatGaussians, tmp_path: Path) -> None:
    index, *_ = export_scene(scene, tmp_path / "out" / "tileset.json")
    found: list[int] = []
    for tile, depth in walk(tileset_of(index)["root"]):
        if depth < 3:
            continue
        cloud = cloud_of(index, tile)
        distances = np.linalg.norm(cloud.means_world[:, None] - scene.means_world[None], axis=2)
        rows = distances.argmin(axis=1)
        found += rows.tolist()
        part = scene.select(rows)
        ours = GaussianCloud(part.means_world, part.quats_wxyz, part.log_scales, part.opacity_logits, part.sh)
        theirs = replace(cloud, log_scales=cloud.log_scales[:, 1:])
        # SPZ: 12 bits after the point, and the steps of its bytes
        difference(ours, theirs).assert_below(
            position=2.0**-13 * 1.01, rotation_degrees=0.35, log_scale=1 / 32, opacity=0.0021, sh=0.07
        )
    assert sorted(found) == list(range(len(scene)))


def test_coarser_levels_look_like_the_scene(scene: FlatGaussians, tmp_path: Path) -> None:
    index, *_ = export_scene(scene, tmp_path / "out" / "tileset.json")
    path = index.parent / tileset_of(index)["root"]["content"]["uri"]
    root, report = read_scene(path)
    assert (report.count, report.flattened, report.sh_degree) == (45, 0, 3)

    def mass(some: FlatGaussians) -> float:
        return float((some.opacities * some.scales.prod(axis=1)).sum())

    assert mass(root) == pytest.approx(mass(scene), rel=0.05)


def georeference(crs: str | None = WGS84) -> Georeference:
    matrix = np.eye(4)
    matrix[:3, :3] = 3.0 * np.array([[0.6, 0, -0.8], [0.8, 0, 0.6], [0, -1, 0]])
    matrix[:3, 3] = (5.0, -4.0, 2.0)
    anchor = {WGS84: (48.137222, 11.575556, 520.0)}.get(crs or "", (691_600.0, 5_334_760.0, 520.0))
    place = {} if crs is None else {"crs": crs, "anchor": anchor}
    return Georeference(matrix=matrix_rows(matrix), **place)


def placed_means(index: Path) -> np.ndarray:
    """What a viewer makes of all leaves: node, quarter turn from y up to z up, transform of the root."""
    root = tileset_of(index)["root"]
    transform = np.array(root.get("transform", np.eye(4).T.reshape(-1))).reshape(4, 4).T
    quarter_turn = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    found = []
    for tile, _ in walk(root):
        if tile.get("children"):
            continue
        path = index.parent / tile["content"]["uri"]
        (node,) = GlbFile(path).document["nodes"]
        matrix = transform @ quarter_turn @ np.array(node["matrix"]).reshape(4, 4).T
        own = (importer_for(path).read(path).means_world * (1, -1, -1)).astype(np.float64)
        own -= np.array(node["matrix"])[12:15]  # the reader has added it
        found.append(own @ matrix[:3, :3].T + matrix[:3, 3])
    return np.concatenate(found)


def assert_same_points(found: np.ndarray, expected: np.ndarray, atol: float) -> None:
    assert found.shape == expected.shape
    nearest = np.linalg.norm(found[:, None] - expected[None], axis=2)
    assert nearest.min(axis=1).max() < atol and sorted(nearest.argmin(axis=1)) == list(range(len(expected)))


@pytest.mark.parametrize("crs", [WGS84, "EPSG:32632"])
@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (100.0, -2000.0, 30.0)], ids=["near", "far"])
def test_tiles_stand_where_the_georeference_says(
    scene: FlatGaussians, tmp_path: Path, crs: str, origin: tuple[float, float, float]
) -> None:
    given = georeference(crs)
    facts = SceneMetadata(georeference=given, origin_world=origin)
    index, *_ = export_scene(scene, tmp_path / "out" / "tileset.json", ExportOptions(facts=facts))
    frame = geocentric_from_metres(given)
    assert frame is not None
    matrix = frame @ given.metres_from_scene
    user = scene.means_world.astype(np.float64) + origin
    assert_same_points(placed_means(index), user @ matrix[:3, :3].T + matrix[:3, 3], 1e-3)
    assert dropped_on_export(scene, [index], facts=facts) == ()


def test_scene_of_known_size_is_in_metres_with_a_warning(scene: FlatGaussians, tmp_path: Path) -> None:
    for given, words in (
        (georeference(None), "no place on the Earth .* in metres about its origin"),
        (georeference("EPSG:2056"), "EPSG:2056 is not known here .* in metres about its origin"),
    ):
        facts = SceneMetadata(georeference=given)
        index, *_ = export_scene(scene, tmp_path / "out" / "tileset.json", ExportOptions(facts=facts))
        matrix = given.metres_from_scene
        assert_same_points(placed_means(index), scene.means_world @ matrix[:3, :3].T + matrix[:3, 3], 1e-3)
        (text,) = dropped_on_export(scene, [index], facts=facts)
        with pytest.raises(AssertionError, match=words):
            raise AssertionError(text)


def test_scene_without_a_place_keeps_its_coordinates_with_a_warning(
    scene: FlatGaussians, tmp_path: Path
) -> None:
    index, *_ = export_scene(scene, tmp_path / "out" / "tileset.json")
    assert_same_points(placed_means(index), in_tile_frame(scene.means_world), 1e-3)
    (text,) = dropped_on_export(scene, [index])
    assert "no place on the Earth" in text and "in the coordinates of the scene, z up" in text


def test_a_small_scene_is_one_tile(scene: FlatGaussians, tmp_path: Path) -> None:
    index, content = export_scene(scene.select(slice(0, 50)), tmp_path / "out" / "tileset.json")
    root = tileset_of(index)["root"]
    assert root["geometricError"] == 0 and "children" not in root
    assert content == index.parent / root["content"]["uri"]


def test_same_scene_gives_the_same_bytes(scene: FlatGaussians, tmp_path: Path) -> None:
    first = export_scene(scene, tmp_path / "a" / "tileset.json")
    second = export_scene(scene, tmp_path / "b" / "tileset.json")
    assert [path.name for path in first] == [path.name for path in second]
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes()


def test_levels_in_files_are_not_in_what_is_removed_before_them(
    scene: FlatGaussians, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """NFS keeps something in the folder of a file that is held, so that the folder cannot be removed."""
    held: list[str] = []
    remove = tempfile.TemporaryDirectory.cleanup

    def look_and_remove(folder: tempfile.TemporaryDirectory[str]) -> None:
        maps = Path("/proc/self/maps").read_text().splitlines()
        held.extend(line for line in maps if f"{folder.name}/" in line)
        remove(folder)

    monkeypatch.setattr(tempfile.TemporaryDirectory, "cleanup", look_and_remove)
    export_scene(scene, tmp_path / "out" / "tileset.json")
    assert held == []


def test_gaussians_in_one_place_are_written(tmp_path: Path) -> None:
    """No plane parts them, so that cells are empty."""
    shell = shell_scene(200)
    heap = replace(shell, means_world=np.ones_like(shell.means_world))
    index, *_ = export_scene(heap, tmp_path / "out" / "tileset.json")
    tiles = [tile for tile, _ in walk(tileset_of(index)["root"])]
    assert all(len(tile.get("children", ())) <= 1 for tile in tiles)
    assert [len(cloud_of(index, tile).means_world) for tile in tiles] == [50, 100, 200]


def test_tiles_of_before_are_replaced_and_nothing_else(scene: FlatGaussians, tmp_path: Path) -> None:
    index, *former = export_scene(scene, tmp_path / "out" / "tileset.json")
    _, *again = export_scene(scene.select(slice(0, 50)), index)
    assert set(again) < set(former)
    assert sorted(path.name for path in index.parent.rglob("*")) == ["0_0.glb", "tiles", "tileset.json"]
    (index.parent / "tiles" / "mine.txt").write_text("kept")
    before = index.read_bytes()
    with pytest.raises(SceneFileError, match="tiles is there already and no part of it"):
        export_scene(scene, index)
    assert (index.parent / "tiles" / "mine.txt").exists() and index.read_bytes() == before
    (index.parent / "tiles" / "mine.txt").unlink()
    index.write_text('{"root": {"content": {"uri": "elsewhere/a.glb"}}}')
    with pytest.raises(SceneFileError, match="tiles is there already and no part of it"):
        export_scene(scene, index)


def test_export_that_finds_no_room_for_its_index_leaves_the_one_of_before(
    scene: FlatGaussians, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    index, *_ = export_scene(scene, tmp_path / "out" / "tileset.json")
    before = {path: path.read_bytes() for path in index.parent.rglob("*") if path.is_file()}

    def find_no_room(*_arguments: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(shutil, "copyfile", find_no_room)
        for path in (index, tmp_path / "new" / "tileset.json"):
            with pytest.raises(DiskFullError):
                export_scene(scene.select(slice(0, 50)), path)
    assert {path: path.read_bytes() for path in index.parent.rglob("*") if path.is_file()} == before
    assert list((tmp_path / "new").iterdir()) == []


@pytest.mark.parametrize(("has_former", "done"), [(False, 0), (False, 1), (True, 0), (True, 1), (True, 2)])
def test_export_goes_on_where_one_was_killed_while_it_moved_tiles(
    scene: FlatGaussians, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_former: bool, done: int
) -> None:
    index = tmp_path / "out" / "tileset.json"
    if has_former:  # whose tiles are moved first
        export_scene(scene.select(slice(0, 200)), index)
    places: list[Path] = []
    move = shutil.move

    def move_until_killed(source: Path, target: Path) -> None:
        if len(places) < done:
            move(source, target)
        places.append(target)
        if len(places) >= max(done, 1):
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(shutil, "move", move_until_killed)
        with pytest.raises(KeyboardInterrupt):
            export_scene(scene, index)
    assert not index.exists()
    export_scene(scene, index)
    whole, *_ = export_scene(scene, tmp_path / "whole" / "tileset.json")

    def content(folder: Path) -> dict[str, bytes]:
        files = (path for path in folder.rglob("*") if path.is_file())
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}

    assert content(index.parent) == content(whole.parent)


def test_unfit_scenes_are_refused(scene: FlatGaussians, tmp_path: Path) -> None:
    means = scene.means_world.copy()
    means[0, 0] = 1e9
    with pytest.raises(SceneFileError, match="SPZ holds positions up to 8388607 units"):
        export_scene(replace(scene, means_world=means), tmp_path / "out" / "tileset.json")
    assert list((tmp_path / "out").iterdir()) == []


def test_positions_that_share_a_tile_with_far_ones_are_told(scene: FlatGaussians, tmp_path: Path) -> None:
    facts = SceneMetadata(georeference=georeference())
    index = tmp_path / "out" / "tileset.json"
    assert dropped_on_export(scene, [index], facts=facts) == ()
    means = scene.means_world.copy()
    means[:2] = [[2.0e6, 3.0, -2.0], [-2.0e6, 20.0, 1.0]]
    far = replace(scene, means_world=means)
    (text,) = dropped_on_export(far, [index], facts=facts)
    assert "holds positions in steps of" in text
    index, *_ = export_scene(far, index, ExportOptions(facts=facts))
    leaves = [tile for tile, depth in walk(tileset_of(index)["root"]) if depth == 3]
    found = np.concatenate([cloud_of(index, tile).means_world for tile in leaves])
    apart = np.linalg.norm(found[:, None] - means[None, 2:], axis=2).min(axis=0)
    sizes = far.scales[2:].max(axis=1)
    told = int(text.split("size of ")[1].split(" of ")[0].replace(",", ""))
    assert 0 < (apart > sizes).sum() <= told < len(scene)
