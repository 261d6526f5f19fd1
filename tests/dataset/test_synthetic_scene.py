"""The generated scene: its files agree with each other, with its mesh, and from run to run."""

import hashlib
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pycolmap
import pytest

from octasplat.engine.core.errors import ConfigError, DatasetError, OutputError
from octasplat.engine.dataset.synthetic import CAMERA_MODELS, SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.dataset.synthetic.patterns import (
    cell_noise,
    gradient_noise,
    linear_from_hex,
    octagon_pattern,
    text_mask,
)
from octasplat.engine.dataset.synthetic.still_life import (
    FLOOR_Z,
    ROOM_INRADIUS,
    TABLE_RADIUS,
    build_still_life,
)

SMALL = SyntheticDatasetConfig(views=6, width_px=48, height_px=36, samples_per_side=2, points=150)


def small(**changes: object) -> SyntheticDatasetConfig:
    return SyntheticDatasetConfig(**{**SMALL.as_dict(), **changes})


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("generated") / "scene"
    write_synthetic_dataset(root, SMALL)
    return root


def pixels(path: Path) -> np.ndarray:
    straight = oiio.ImageSpec()
    straight.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(str(path), straight)
    assert source is not None, oiio.geterror()
    kind = "uint8" if path.suffix == ".png" else "float"
    spec = source.spec()
    read = np.asarray(source.read_image(kind)).reshape(spec.height, spec.width, spec.nchannels)
    source.close()
    return read


def digests(root: Path) -> dict[str, str]:
    files = sorted(path for path in root.rglob("*") if path.is_file())
    return {str(path.relative_to(root)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def mesh_file(path: Path) -> tuple[np.ndarray, np.ndarray]:
    header, body = path.read_bytes().split(b"end_header\n", 1)
    counts = {
        line.split()[1]: int(line.split()[2]) for line in header.split(b"\n") if line.startswith(b"element")
    }
    vertices = np.frombuffer(body, "<f4", 3 * counts[b"vertex"]).reshape(-1, 3)
    rows = np.frombuffer(body[vertices.nbytes :], [("corners", "u1"), ("indices", "<i4", 3)])
    assert len(rows) == counts[b"face"]
    assert (rows["corners"] == 3).all()
    return vertices, rows["indices"]


def pixel_rays(
    model: pycolmap.Reconstruction, image: pycolmap.Image
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Camera centre, directions in world axes with z = 1 in the camera frame, and pixels (row, column)."""
    camera = model.cameras[image.camera_id]
    rows, columns = np.mgrid[: camera.height, : camera.width]
    xy = camera.cam_from_img(np.stack([columns + 0.5, rows + 0.5], axis=-1).reshape(-1, 2))
    rotation = image.cam_from_world().rotation.matrix()
    directions = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) @ rotation
    return image.projection_center(), directions, np.stack([rows, columns], axis=-1).reshape(-1, 2)


def first_hits(
    vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances and faces of first hits, by trying every triangle (Moeller and Trumbore)."""
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    e1, e2, s = b - a, c - a, origin - a
    q = np.cross(s, e1)
    found = []
    for direction in directions:
        p = np.cross(direction, e2)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1 / np.sum(p * e1, axis=1)
            u, v = np.sum(p * s, axis=1) * scale, (q @ direction) * scale
            t = np.sum(q * e2, axis=1) * scale
            inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6)
        t = np.where(inside, t, np.inf)
        found.append((t.min(), t.argmin()))
    distances, ids = zip(*found, strict=True)
    return np.array(distances), np.array(ids)


def test_synthetic_scene_writes_all_files(scene: Path) -> None:
    names = [f"view_{k:03d}" for k in range(6)]
    expected = {f"images/{name}.png" for name in names}
    expected |= {f"ground_truth/{kind}/{name}.exr" for name in names for kind in ("depth", "normals")}
    expected |= {f"ground_truth/masks/{name}.png" for name in names}
    expected |= {f"sparse/0/{part}.bin" for part in ("cameras", "rigs", "frames", "images", "points3D")}
    expected |= {"ground_truth/mesh.ply", "generated.json"}
    assert set(digests(scene)) == expected
    assert [path.name for path in scene.parent.iterdir()] == ["scene"]


def test_synthetic_dataset_is_deterministic(scene: Path, tmp_path: Path) -> None:
    write_synthetic_dataset(tmp_path / "again", SMALL)
    assert digests(tmp_path / "again") == digests(scene)
    # Both may have been written in the same second, so look for the time of writing itself.
    for path in (*(scene / "images").iterdir(), *(scene / "ground_truth" / "depth").iterdir()):
        source = oiio.ImageInput.open(str(path))
        assert source.spec().getattribute("DateTime") in (None, "1970:01:01 00:00:00")
        source.close()


def test_synthetic_scene_seed_moves_cameras_only(scene: Path, tmp_path: Path) -> None:
    write_synthetic_dataset(tmp_path / "other", small(seed=1))
    first, second = digests(scene), digests(tmp_path / "other")
    assert first["ground_truth/mesh.ply"] == second["ground_truth/mesh.ply"]
    assert first["sparse/0/images.bin"] != second["sparse/0/images.bin"]
    assert first["images/view_000.png"] != second["images/view_000.png"]


def test_synthetic_model_tracks_reproject(scene: Path) -> None:
    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    assert (model.num_cameras(), model.num_reg_images(), model.num_points3D()) == (1, 6, 150)
    assert model.num_rigs() == 1
    assert model.num_frames() == 6
    assert {image.name for image in model.images.values()} == {f"view_{k:03d}.png" for k in range(6)}
    for point in model.points3D.values():
        assert point.track.length() >= 2
        assert len({element.image_id for element in point.track.elements}) == point.track.length()
        for element in point.track.elements:
            image = model.images[element.image_id]
            observed = image.points2D[element.point2D_idx].xy
            assert np.linalg.norm(image.project_point(point.xyz) - observed) < 0.1
    errors = [point.error for point in model.points3D.values()]
    assert 0 < np.mean(errors) < 0.05


def test_synthetic_scene_points_match_depth(scene: Path) -> None:
    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    offsets = []
    for image in model.images.values():
        depth = pixels(scene / "ground_truth" / "depth" / f"{Path(image.name).stem}.exr")[..., 0]
        for observation in image.points2D:
            column, row = np.floor(observation.xy).astype(int)
            z = (image.cam_from_world() * model.points3D[observation.point3D_id].xyz)[2]
            offsets.append(abs(z - depth[row, column]) / z)
    # A pixel's centre may lie beyond an edge, but that is the exception.
    assert np.median(offsets) < 0.01
    assert np.mean(np.array(offsets) < 0.05) > 0.9


def test_photographs_agree_about_the_color_of_a_point(tmp_path: Path) -> None:
    write_synthetic_dataset(tmp_path / "scene", small(width_px=128, height_px=96, samples_per_side=3))
    model = pycolmap.Reconstruction(str(tmp_path / "scene" / "sparse" / "0"))
    pictures = {
        i: pixels(tmp_path / "scene" / "images" / image.name) / 255 for i, image in model.images.items()
    }

    def seen_in(element: pycolmap.TrackElement) -> np.ndarray:
        column, row = np.floor(model.images[element.image_id].points2D[element.point2D_idx].xy).astype(int)
        return pictures[element.image_id][row, column]

    same, own, unlike = [], [], []
    points = list(model.points3D.values())
    for point, other in zip(points, points[1:] + points[:1], strict=True):
        colors = [seen_in(element) for element in point.track.elements]
        same.append(np.abs(np.diff(colors, axis=0)).mean())
        own.append(np.abs(colors - point.color / 255).mean())
        unlike.append(np.abs(seen_in(other.track.elements[0]) - colors[0]).mean())
    assert np.median(same) < 0.06
    assert np.median(own) < 0.05
    assert np.median(same) < 0.4 * np.median(unlike)


def test_depth_and_normals_are_those_of_the_mesh(scene: Path) -> None:
    vertices, faces = mesh_file(scene / "ground_truth" / "mesh.ply")
    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    image = model.find_image_with_name("view_001.png")
    centre, directions, places = pixel_rays(model, image)
    depth = pixels(scene / "ground_truth" / "depth" / "view_001.exr")[..., 0]
    normals = pixels(scene / "ground_truth" / "normals" / "view_001.exr")
    mask = pixels(scene / "ground_truth" / "masks" / "view_001.png")[..., 0]
    some = np.random.default_rng(0).choice(len(directions), 24, replace=False)
    distances, hit = first_hits(vertices, faces, centre, directions[some])
    rows, columns = places[some].T
    np.testing.assert_allclose(depth[rows, columns], distances, rtol=2e-5)
    a, b, c = (vertices[faces[hit, k]].astype(np.float64) for k in range(3))
    expected = np.cross(b - a, c - a)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    expected *= -np.sign(np.sum(expected * directions[some], axis=1, keepdims=True))
    np.testing.assert_allclose(normals[rows, columns], expected, atol=1e-4)
    np.testing.assert_array_equal(mask[rows, columns] == 255, build_still_life().face_is_foreground[hit])


def test_synthetic_room_geometry(scene: Path) -> None:
    model = pycolmap.Reconstruction(str(scene / "sparse" / "0"))
    assert model.images
    for image in model.images.values():
        stem = Path(image.name).stem
        centre, directions, _ = pixel_rays(model, image)
        depth = pixels(scene / "ground_truth" / "depth" / f"{stem}.exr").reshape(-1, 1)
        normals = pixels(scene / "ground_truth" / "normals" / f"{stem}.exr").reshape(-1, 3)
        is_object = pixels(scene / "ground_truth" / "masks" / f"{stem}.png").reshape(-1) == 255
        assert (depth > 0).all()
        places = centre + depth * directions
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
        assert (np.sum(normals * directions, axis=1) < 0).all()
        on_floor = ~is_object & (normals[:, 2] > 0.5)
        assert on_floor.any()
        np.testing.assert_allclose(places[on_floor, 2], FLOOR_Z, atol=1e-4)
        on_wall = ~is_object & ~on_floor
        outwards = -np.sum(places[on_wall] * normals[on_wall], axis=1)
        np.testing.assert_allclose(outwards, ROOM_INRADIUS, atol=1e-4)
        assert is_object.any()
        assert (np.hypot(places[is_object, 0], places[is_object, 1]) < TABLE_RADIUS + 0.01).all()


@pytest.mark.parametrize("camera_model", CAMERA_MODELS)
def test_synthetic_scene_lens_models_distort_images(tmp_path: Path, camera_model: str) -> None:
    write_synthetic_dataset(tmp_path / "scene", small(views=3, camera_model=camera_model))
    model = pycolmap.Reconstruction(str(tmp_path / "scene" / "sparse" / "0"))
    camera = model.cameras[1]
    assert camera.model_name == camera_model
    grid = np.stack(np.meshgrid(np.linspace(0, 48, 9), np.linspace(0, 36, 7)), axis=-1).reshape(-1, 2)
    rays = np.concatenate([camera.cam_from_img(grid), np.ones((len(grid), 1))], axis=1)
    np.testing.assert_allclose(camera.img_from_cam(rays), grid, atol=1e-3)
    straight = (
        rays[:, :2] * [camera.focal_length_x, camera.focal_length_y] if "OPENCV" in camera_model else None
    )
    if straight is not None:
        bent = grid - [camera.principal_point_x, camera.principal_point_y] - straight
        assert np.abs(bent).max() > 0.5
    # Floor pixels lie on the floor only if the rays were bent just so.
    image = model.images[1]
    centre, directions, _ = pixel_rays(model, image)
    truth = tmp_path / "scene" / "ground_truth"
    depth = pixels(truth / "depth" / "view_000.exr").reshape(-1, 1)
    normals = pixels(truth / "normals" / "view_000.exr").reshape(-1, 3)
    is_object = pixels(truth / "masks" / "view_000.png").reshape(-1) == 255
    on_floor = ~is_object & (normals[:, 2] > 0.5)
    np.testing.assert_allclose((centre + depth * directions)[on_floor, 2], FLOOR_Z, atol=1e-4)


def test_transparent_photographs_show_the_objects_alone(scene: Path, tmp_path: Path) -> None:
    write_synthetic_dataset(tmp_path / "scene", small(transparent=True))
    opaque = pixels(scene / "images" / "view_000.png").astype(int)
    clear = pixels(tmp_path / "scene" / "images" / "view_000.png").astype(int)
    assert clear.shape == (36, 48, 4)
    alpha = clear[..., 3]
    assert {0, 255} < set(np.unique(alpha)) <= {0, 64, 128, 191, 255}
    np.testing.assert_array_equal(clear[alpha == 255, :3], opaque[alpha == 255])
    assert (clear[alpha == 0] == 0).all()
    # Where a pixel is half covered its color is that of the object, not darkened by what is missing.
    edge = (alpha > 0) & (alpha < 255)
    assert clear[edge, :3].mean() > 0.6 * clear[alpha == 255, :3].mean()
    mask = pixels(tmp_path / "scene" / "ground_truth" / "masks" / "view_000.png")[..., 0]
    assert (mask[alpha == 255] == 255).mean() > 0.98
    model = pycolmap.Reconstruction(str(tmp_path / "scene" / "sparse" / "0"))
    xyz = np.array([point.xyz for point in model.points3D.values()])
    assert (np.hypot(xyz[:, 0], xyz[:, 1]) < TABLE_RADIUS + 0.01).all()


def test_synthetic_masks_are_written_to_masks_folder(tmp_path: Path) -> None:
    write_synthetic_dataset(tmp_path / "scene", small(views=3, with_masks=True))
    names = sorted(path.name for path in (tmp_path / "scene" / "masks").iterdir())
    assert names == [f"view_{k:03d}.png.png" for k in range(3)]
    mask = pixels(tmp_path / "scene" / "masks" / "view_000.png.png")
    assert mask.shape == (36, 48, 1)
    np.testing.assert_array_equal(
        mask, pixels(tmp_path / "scene" / "ground_truth" / "masks" / "view_000.png")
    )


def test_progress_counts_the_photographs(tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    write_synthetic_dataset(
        tmp_path / "scene", small(views=3), lambda done, total: calls.append((done, total))
    )
    assert calls == [(0, 3), (1, 3), (2, 3), (3, 3)]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_synthetic_scene_interrupted_leaves_no_files(tmp_path: Path, error: type[BaseException]) -> None:
    def stop(done: int, _total: int) -> None:
        if done == 1:
            raise error

    with pytest.raises(error):
        write_synthetic_dataset(tmp_path / "scene", small(views=3), stop)
    assert list(tmp_path.iterdir()) == []


def test_synthetic_scene_complete_is_reused(scene: Path) -> None:
    times = {path: path.stat().st_mtime_ns for path in scene.rglob("*")}
    write_synthetic_dataset(scene, SMALL)
    assert {path: path.stat().st_mtime_ns for path in scene.rglob("*")} == times


def test_synthetic_scene_fills_empty_folder(tmp_path: Path) -> None:
    (tmp_path / "scene").mkdir()
    write_synthetic_dataset(tmp_path / "scene", small(views=3))
    assert (tmp_path / "scene" / "generated.json").is_file()


def test_synthetic_scene_keeps_existing_files(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(DatasetError, match="no complete generated scene"):
        write_synthetic_dataset(tmp_path, SMALL)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    with pytest.raises(DatasetError, match="is a file"):
        write_synthetic_dataset(tmp_path / "notes.txt", SMALL)
    with pytest.raises(OutputError, match="cannot be written"):
        write_synthetic_dataset(tmp_path / "notes.txt" / "scene", SMALL)
    with pytest.raises(DatasetError, match="other settings"):
        write_synthetic_dataset(scene, small(seed=5))


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(ConfigError, match="views is 2"):
        SyntheticDatasetConfig(views=2)
    with pytest.raises(ConfigError, match="camera_model is 'ORTHO'"):
        SyntheticDatasetConfig(camera_model="ORTHO")


def test_closed_things_face_outwards_and_vertex_normals_follow_their_faces() -> None:
    objects = build_still_life().objects
    assert any(thing.is_foreground and thing.name != "pedestal" for thing in objects)
    for thing in objects:
        mesh = thing.mesh
        a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
        across = np.cross(b - a, c - a)
        agreement = np.sum(across[:, None] * mesh.normals[mesh.faces], axis=-1)
        assert np.mean(agreement > 0) > 0.99, thing.name
        if thing.is_foreground and thing.name != "pedestal":
            assert np.sum(a * np.cross(b, c)) / 6 > 0, thing.name


def test_pattern_images_match_their_names() -> None:
    random = np.random.default_rng(0)
    first, second = random.uniform(-4, 4, (2, 200_000)).astype(np.float32)
    # A regular octagon of apothem r has the area 8 r^2 tan(pi / 8).
    assert octagon_pattern(first, second, 0.4).mean() == pytest.approx(8 * 0.16 * np.tan(np.pi / 8), abs=0.01)
    assert cell_noise(first, second).mean() == pytest.approx(0.5, abs=0.1)
    rough = gradient_noise(np.stack([first, second, first * second], axis=1), octaves=3)
    assert abs(rough.mean()) < 0.05
    assert 0.15 < rough.std() < 0.6
    np.testing.assert_allclose(linear_from_hex("ff8000"), [1, 0.2158605, 0], atol=1e-6)
    # The letter T: a bar above, a stem below.
    x = (np.arange(5, dtype=np.float32) + 0.5) / 6
    np.testing.assert_array_equal(text_mask(x, np.full(5, -0.05, np.float32), ["T"]), [1, 1, 1, 1, 1])
    np.testing.assert_array_equal(text_mask(x, np.full(5, -0.55, np.float32), ["T"]), [0, 0, 1, 0, 0])
