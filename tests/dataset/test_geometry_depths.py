"""A mesh or a cloud of points beside photographs gives them depths."""

import shutil
import struct
from pathlib import Path

import laspy
import numpy as np
import pycolmap
import pytest

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.scene_layout import FileRole, file_role, lay_out_scene
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.depth_maps import depth_maps_digest
from octasplat.engine.dataset.known_geometry import GeometryDepths, thin_points
from octasplat.engine.dataset.load import load_dataset_model
from octasplat.engine.dataset.model import PosedView
from octasplat.engine.files import read_mesh
from octasplat.engine.geometry.imported_mesh import ImportedMesh
from octasplat.engine.runs.geometry_file import find_known_geometry, read_geometry
from tests.support.tiny_dataset import make_tiny_dataset

CAMERA = Camera("PINHOLE", (80.0, 80.0, 40.0, 30.0), 80, 60)
NO_FACES = np.zeros((0, 3), np.int64)


def view_from(z: float) -> PosedView:
    """A view from (0, 0, z) along +z."""
    return PosedView("a.png", 0, np.eye(3), np.array([0.0, 0.0, -z]), 80, 60)


def grid(side: int, half: float, z: float) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-half, half, side), np.linspace(-half, half, side))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)


def test_mesh_gives_the_depth_along_the_axis_of_view() -> None:
    corners = np.array([[-9.0, -9, 2], [9, -9, 2], [9, 9, 6.5], [-9, 9, 6.5]])  # z = 4.25 + y / 4
    mesh = ImportedMesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    depth = GeometryDepths(mesh).view(view_from(1.0), CAMERA)
    slope = (np.arange(60) + 0.5 - 30) / 80  # y / z of the pixels of each row
    expected = (3.25) / (1 - slope / 4)
    np.testing.assert_allclose(depth, np.broadcast_to(expected[:, None], (60, 80)), rtol=1e-5)
    behind = GeometryDepths(mesh).view(view_from(20.0), CAMERA)
    assert not behind.any()


def test_points_in_front_hide_those_behind() -> None:
    near, far = grid(61, 0.6, 2.0), grid(201, 4.0, 4.0)
    cloud = ImportedMesh(np.concatenate([near, far]), NO_FACES)
    depth = GeometryDepths(cloud).view(view_from(0.0), CAMERA)
    x = (np.arange(80) + 0.5 - 40) / 80
    y = (np.arange(60) + 0.5 - 30) / 80
    from_middle = np.maximum(np.abs(2 * x)[None], np.abs(2 * y)[:, None])  # on the near plane
    on_near, known = from_middle < 0.6, depth > 0
    # the rim belongs to the near plane up to 0.6 of its spacing, 0.02, or twice that at its corners
    beside = from_middle > 0.6 + 0.6 * 0.04
    assert known[on_near].mean() > 0.9 and known[beside].mean() > 0.7
    np.testing.assert_allclose(depth[known & on_near], 2.0, rtol=1e-4)
    np.testing.assert_allclose(depth[known & beside], 4.0, rtol=1e-4)


def test_depths_do_not_depend_on_threads() -> None:
    random = np.random.default_rng(0)
    points = random.standard_normal((3000, 3)) * (1, 1, 0.3) + np.array([0, 0, 4])
    cloud = ImportedMesh(points, NO_FACES)
    one, two = (GeometryDepths(cloud, threads).view(view_from(0.0), CAMERA) for threads in (1, 2))
    np.testing.assert_array_equal(one, two)


def test_thinning_keeps_points_and_a_limit() -> None:
    points = np.random.default_rng(1).uniform(0, 1, (5000, 3)) * (1, 1, 0)
    thin = thin_points(points, 700)
    assert 200 < len(thin) <= 700
    assert len(np.unique(np.concatenate([points, thin]), axis=0)) == len(points)  # nothing new
    assert thin_points(points, 5000) is points
    # one reading far away does not make the cells large
    strays = np.concatenate([points, np.full((1, 3), 1e7)])
    assert 200 < len(thin_points(strays, 700)) <= 700
    assert len(thin_points(np.zeros((50, 3)), 10)) == 1


@pytest.mark.parametrize("name", ["geometry.las", "geometry.laz"])
def test_laser_scan_is_read_in_full(tmp_path: Path, name: str) -> None:
    points = np.random.default_rng(2).uniform(0, 100, (500, 3)).round(3)
    points += np.array([400_000, 5_000_000, 80])
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.offsets, header.scales = points.min(axis=0), np.full(3, 0.001)
    scan = laspy.LasData(header)
    scan.x, scan.y, scan.z = points.T
    path = tmp_path / name
    scan.write(path)
    found = read_geometry(path)
    assert len(found.triangles) == 0
    np.testing.assert_allclose(found.vertices, points, atol=1e-3)
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(DatasetError, match=name):
        read_geometry(path)


def test_damaged_laser_scans_are_refused_in_a_sentence(tmp_path: Path) -> None:
    header = laspy.LasHeader(point_format=3, version="1.4")
    scan = laspy.LasData(header)
    scan.x, scan.y, scan.z = np.random.default_rng(2).uniform(0, 100, (3, 500))
    for name in ("geometry.las", "geometry.laz"):
        path = tmp_path / name
        scan.write(path)
        whole = path.read_bytes()
        (begin,) = struct.unpack_from("<I", whole, 96)
        damages = {
            "records": (100, struct.pack("<I", 1 << 31)),
            "extended records": (235, struct.pack("<QI", begin, 1 << 31)),
            "scale": (131, struct.pack("<d", np.nan)),
        }
        if path.suffix == ".laz":
            (table,) = struct.unpack_from("<q", whole, begin)
            damages["compressed parts"] = (table + 4, struct.pack("<I", (1 << 32) - 1))
            damages["place of their table"] = (begin, struct.pack("<q", 1 << 60))
            damages["points of a part"] = (whole.index(b"laszip encoded") + 52 + 12, struct.pack("<I", 0))
        for where, (place, value) in damages.items():
            path.write_bytes(whole[:place] + value + whole[place + len(value) :])
            with pytest.raises(DatasetError, match=name):
                read_geometry(path)
                pytest.fail(f"{where} of {name}")
        for length in (3, 90, 110, 180, 240, 300, len(whole) - 20):
            path.write_bytes(whole[:length])
            with pytest.raises(DatasetError, match=name):
                read_geometry(path)


def test_geometry_is_a_part_of_a_scene() -> None:
    assert file_role("geometry.ply") == file_role("Geometry.LAZ") == FileRole.GEOMETRY
    assert file_role("sub/geometry.ply") == FileRole.OTHER
    names = [*(f"site/images/{n}.jpg" for n in "abc"), "site/geometry.ply", "site/other.ply"]
    found = lay_out_scene(names)
    assert found.files["geometry.ply"] == "site/geometry.ply"
    assert found.left_out == ("site/other.ply",)


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_dataset(tmp_path_factory)


@pytest.fixture
def with_geometry(generated: Path, tmp_path: Path) -> Path:
    scene = tmp_path / "scene"
    shutil.copytree(generated, scene)
    shutil.copy(scene / "ground_truth" / "mesh.ply", scene / "geometry.ply")
    return scene


def known_distances(dataset: Dataset, view: int) -> np.ndarray:
    width, height = dataset.views[view].width_px, dataset.views[view].height_px
    y, x = np.divmod(np.arange(width * height), width)
    return dataset.known_distances(np.full(len(y), view), y, x)


def open_dataset(scene: Path, cache: Path) -> Dataset:
    return Dataset.open(scene, cache, geometry=find_known_geometry(scene))


def test_true_mesh_gives_the_distances_of_true_depth_maps(with_geometry: Path, tmp_path: Path) -> None:
    dataset = open_dataset(with_geometry, tmp_path / "cache")
    assert any("geometry.ply is taken as known geometry" in text for text in dataset.warnings)
    (with_geometry / "geometry.ply").unlink()
    shutil.copytree(with_geometry / "ground_truth" / "depth", with_geometry / "depths")
    by_maps = Dataset.open(with_geometry, tmp_path / "maps", depth_unit=1.0)
    for view in range(len(dataset.views)):
        found, expected = known_distances(dataset, view), known_distances(by_maps, view)
        both = (found > 0) & (expected > 0)
        assert both.mean() > 0.9 * (expected > 0).mean() > 0
        assert np.median(np.abs(found[both] / expected[both] - 1)) < 2e-3


def test_geometry_below_zero_stays_in_place_in_map_coordinates(with_geometry: Path, tmp_path: Path) -> None:
    near = open_dataset(with_geometry, tmp_path / "near")
    offset = np.array([512_345.25, 5_403_210.5, -0.49])  # cameras stand above zero, the floor lies below
    mesh = read_mesh(with_geometry / "geometry.ply")
    lines = [f"v {x:.12g} {y:.12g} {z:.12g}" for x, y, z in mesh.vertices + offset]
    lines += [f"f {a} {b} {c}" for a, b, c in mesh.triangles + 1]
    (with_geometry / "geometry.ply").unlink()
    (with_geometry / "geometry.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
    folder = load_dataset_model(with_geometry).model_folder
    model = pycolmap.Reconstruction(str(folder))
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), offset))
    model.write_binary(str(folder))
    far = open_dataset(with_geometry, tmp_path / "far")
    assert far.origin_world[2] == 1.0
    for view in range(len(far.views)):
        np.testing.assert_allclose(known_distances(far, view), known_distances(near, view), rtol=1e-3)


def test_photographs_with_a_map_of_their_own_keep_it(with_geometry: Path, tmp_path: Path) -> None:
    maps = sorted((with_geometry / "ground_truth" / "depth").iterdir())
    (with_geometry / "depths").mkdir()
    shutil.copy(maps[2], with_geometry / "depths" / maps[2].name)
    geometry = find_known_geometry(with_geometry)
    assert geometry is not None
    mixed = Dataset.open(with_geometry, tmp_path / "mixed", depth_unit=2.0, geometry=geometry)
    alone = Dataset.open(with_geometry, tmp_path / "alone", depth_unit=2.0)
    np.testing.assert_array_equal(known_distances(mixed, 2), known_distances(alone, 2))
    assert known_distances(mixed, 1).any() and not known_distances(alone, 1).any()
    # the unit of the maps is found by the views that have one, and is none of the geometry's
    fitted = Dataset.open(with_geometry, tmp_path / "fitted", geometry=geometry)
    np.testing.assert_allclose(known_distances(fitted, 1), known_distances(mixed, 1))


@pytest.mark.exhaustive
def test_geometry_elsewhere_is_refused(with_geometry: Path, tmp_path: Path) -> None:
    mesh = read_mesh(with_geometry / "geometry.ply")
    for number, moved in enumerate((mesh.vertices * 1.5, mesh.vertices + np.array([1000.0, 0, 0]))):
        lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in moved]
        lines += [f"f {a} {b} {c}" for a, b, c in mesh.triangles + 1]
        (with_geometry / "geometry.ply").unlink(missing_ok=True)
        (with_geometry / "geometry.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
        with pytest.raises(DatasetError, match=r"geometry\.obj .*coordinates of the poses"):
            open_dataset(with_geometry, tmp_path / f"cache{number}")


def test_corrected_poses_give_other_distances(with_geometry: Path, tmp_path: Path) -> None:
    before = open_dataset(with_geometry, tmp_path / "cache")
    model = pycolmap.Reconstruction(str(load_dataset_model(with_geometry).model_folder))
    moved = next(image for image in model.images.values() if image.name == before.views[0].name)
    pose = moved.frame.rig_from_world
    moved.frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, pose.translation + np.array([0, 0, 0.5]))
    corrected = tmp_path / "corrected"
    corrected.mkdir()
    model.write(str(corrected))
    geometry = find_known_geometry(with_geometry)
    after = Dataset.open(with_geometry, tmp_path / "cache", geometry=geometry, model_folder=corrected)
    fresh = Dataset.open(with_geometry, tmp_path / "fresh", geometry=geometry, model_folder=corrected)
    np.testing.assert_array_equal(known_distances(after, 0), known_distances(fresh, 0))
    assert not np.allclose(known_distances(before, 0), known_distances(fresh, 0), rtol=0.02)
    assert before.views_record.depths_sha256 == after.views_record.depths_sha256  # of the files alone


@pytest.mark.exhaustive
def test_changed_geometry_is_noticed(with_geometry: Path, tmp_path: Path) -> None:
    model, first = load_dataset_model(with_geometry), find_known_geometry(with_geometry)
    mesh = read_mesh(with_geometry / "geometry.ply")
    before = open_dataset(with_geometry, tmp_path / "cache")
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices * 1.01]
    lines += [f"f {a} {b} {c}" for a, b, c in mesh.triangles + 1]
    (with_geometry / "geometry.obj").write_text("\n".join(lines) + "\n", encoding="utf-8")
    with pytest.raises(DatasetError, match="2 files of known geometry"):
        find_known_geometry(with_geometry)
    (with_geometry / "geometry.ply").unlink()
    second = find_known_geometry(with_geometry)
    assert depth_maps_digest(model, first) != depth_maps_digest(model, second)
    after = open_dataset(with_geometry, tmp_path / "cache")
    assert not np.allclose(known_distances(before, 0), known_distances(after, 0), rtol=1e-4)
    assert before.views_record.difference(after.views_record) == "other depth maps or another known geometry"
