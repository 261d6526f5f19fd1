"""A lens that moved between photographs is noticed and given to each of them, and none that stood still."""

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.events import Event, PhaseFinished, Warned
from octasplat.engine.dataset.load import load_dataset_model
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.pipeline import reconstruct
from octasplat.engine.poses.find_poses import adjust_principal_points
from octasplat.engine.poses.lens_check import needs_per_view_principal_points
from octasplat.engine.runs.config import resolve_config
from tests.support.stopped_run import reconstruct_until

VIEWS = 20
NOISE_PX = 0.3
SHIFTS_PX = np.random.default_rng(7).uniform(-12, 12, (VIEWS, 2)).round()
SETTINGS = (
    "iterations=1000",
    "rays_per_batch=512",
    "max_gaussians=500",
    "probe_rays=256",
    "repair_poses=false",
)


def write_scene(root: Path, shifts_px: np.ndarray) -> Path:
    """Generated photographs moved by whole pixels, with what they show of the points, found to 0.3 px."""
    write_synthetic_dataset(
        root,
        SyntheticDatasetConfig(views=VIEWS, width_px=240, height_px=180, samples_per_side=1, points=1500),
    )
    model = pycolmap.Reconstruction(str(root / "sparse" / "0"))
    rng = np.random.default_rng(3)
    for image, shift in zip(sorted(model.images.values(), key=lambda i: i.name), shifts_px, strict=True):
        for spot in image.points2D:
            spot.xy = spot.xy + shift + rng.normal(0, NOISE_PX, 2)
        path = root / "images" / image.name
        bitmap = pycolmap.Bitmap.read(str(path), True)
        moved = np.roll(bitmap.to_array(), shift.astype(int)[::-1], axis=(0, 1))
        pycolmap.Bitmap.from_array(np.ascontiguousarray(moved)).write(str(path))
    model.write_binary(str(root / "sparse" / "0"))
    return root


@pytest.fixture(scope="module")
def moved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("moved") / "scene", SHIFTS_PX)


@pytest.fixture(scope="module")
def still(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("still") / "scene", np.zeros((VIEWS, 2)))


def principal_points(model: Path) -> np.ndarray:
    found = pycolmap.Reconstruction(str(model))
    images = sorted(found.images.values(), key=lambda image: image.name)
    cameras = [found.cameras[image.camera_id] for image in images]
    return np.array([[camera.principal_point_x, camera.principal_point_y] for camera in cameras])


def centres(model: Path) -> np.ndarray:
    images = sorted(pycolmap.Reconstruction(str(model)).images.values(), key=lambda image: image.name)
    return np.array([image.projection_center() for image in images])


@pytest.mark.exhaustive
def test_lens_check_flags_shifted_principal_points_only(moved: Path, still: Path) -> None:
    for root, expected in ((moved, True), (still, False)):
        scene = load_dataset_model(root)
        assert needs_per_view_principal_points(scene, scene.points, scene.observations) is expected


@pytest.mark.exhaustive
def test_shifted_principal_points_are_found(moved: Path, tmp_path: Path) -> None:
    model, found = moved / "sparse" / "0", tmp_path / "found"
    facts = adjust_principal_points(model, found)
    assert facts is not None
    assert facts["reprojection_px"] < 1.1 * NOISE_PX < 0.75 * facts["reprojection_px_before"]
    given = principal_points(model)
    np.testing.assert_allclose(principal_points(found) - given, SHIFTS_PX, atol=2.0)
    # The cameras stand where they stood: the given poses were right but for the pictures.
    size = np.linalg.norm(centres(model) - centres(model).mean(axis=0), axis=1).mean()
    np.testing.assert_allclose(centres(found), centres(model), atol=0.01 * size)
    assert json.loads((found / "poses.json").read_text())["lenses"] == facts
    again = tmp_path / "again"
    adjust_principal_points(model, again)
    for path in found.iterdir():
        assert (again / path.name).read_bytes() == path.read_bytes()
    # The folder of the model itself may be the one to change; what its record says stays.
    (again / "poses.json").write_text('{"moved": ["a.png"]}')
    assert adjust_principal_points(again, again) is None
    assert json.loads((again / "poses.json").read_text()) == {"moved": ["a.png"]}


@pytest.mark.exhaustive
def test_lens_fit_keeps_unshifted_principal_point(still: Path, tmp_path: Path) -> None:
    assert adjust_principal_points(still / "sparse" / "0", tmp_path / "none") is None
    assert not any(tmp_path.iterdir())


def test_lens_fit_unreadable_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"gone.cameras.txt cannot be read"):
        adjust_principal_points(tmp_path / "gone", tmp_path / "none")
    assert not any(tmp_path.iterdir())


def test_photograph_with_few_points_keeps_lens(moved: Path, tmp_path: Path) -> None:
    model = pycolmap.Reconstruction(str(moved / "sparse" / "0"))
    poor, none = sorted(model.images.values(), key=lambda image: image.name)[4:6]
    for image, left in ((poor, 60), (none, 0)):
        shown = [k for k, spot in enumerate(image.points2D) if spot.has_point3D()]
        for k in shown[left:]:
            model.delete_observation(image.image_id, k)
    given = tmp_path / "given"
    given.mkdir()
    model.write_binary(str(given))
    assert adjust_principal_points(given, tmp_path / "found") is not None
    shifts = principal_points(tmp_path / "found") - principal_points(given)
    assert not shifts[4:6].any()
    assert np.abs(np.delete(shifts - SHIFTS_PX, [4, 5], axis=0)).max() < 2.5
    poses = [
        pycolmap.Reconstruction(str(folder)).images[none.image_id].cam_from_world().matrix()
        for folder in (given, tmp_path / "found")
    ]
    np.testing.assert_allclose(poses[0], poses[1], atol=1e-12)


def write_rail(folder: Path, across: float) -> None:
    """Write a model of cameras so near to a line, each with a principal point of its own."""
    rng, model = np.random.default_rng(1), pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(camera_id=1, model="PINHOLE", width=240, height=180, params=[220, 220, 120, 90])
    )
    points = np.stack([rng.uniform(-3, 13, 900), rng.uniform(-3, 3, 900), rng.uniform(3, 8, 900)], axis=1)
    tracks = [pycolmap.Track() for _ in points]
    for number, x in enumerate(np.linspace(0, 10, 16), start=1):
        centre = np.array([x, *(across * rng.standard_normal(2))])
        rotation = pycolmap.Rotation3d(np.radians(rng.uniform(-8, 8, 3)))
        points_cam = (points - centre) @ rotation.matrix().T
        xy_px = 220 * points_cam[:, :2] / points_cam[:, 2:] + [120, 90]
        seen = np.flatnonzero((xy_px > 0).all(axis=1) & (xy_px < [240, 180]).all(axis=1))
        spots = xy_px[seen] + rng.uniform(-12, 12, 2).round() + rng.normal(0, NOISE_PX, (len(seen), 2))
        image = pycolmap.Image(
            name=f"{number:03d}.png",
            points2D=pycolmap.Point2DList([pycolmap.Point2D(spot) for spot in spots]),
            camera_id=1,
            image_id=number,
        )
        pose = pycolmap.Rigid3d(rotation, -rotation.matrix() @ centre)
        model.add_image_with_trivial_frame(image, pose)
        for place, point in enumerate(seen.tolist()):
            tracks[point].add_element(number, place)
    for point, track in zip(points, tracks, strict=True):
        if track.length() > 1:
            model.add_point3D(point, track)
    folder.mkdir()
    model.write_binary(str(folder))


@pytest.mark.parametrize("across", [1e-4, 1e-3, 0.3])
def test_cameras_on_a_rail_are_not_turned_about_it(tmp_path: Path, across: float) -> None:
    write_rail(tmp_path / "given", across)
    assert adjust_principal_points(tmp_path / "given", tmp_path / "found") is not None
    given, found = (pycolmap.Reconstruction(str(tmp_path / name)) for name in ("given", "found"))
    for number, image in given.images.items():
        turned = found.images[number].cam_from_world().rotation.matrix()
        between = image.cam_from_world().rotation.matrix() @ turned.T
        assert np.degrees(np.arccos((np.trace(between) - 1) / 2)) < 2.0
    np.testing.assert_allclose(centres(tmp_path / "found"), centres(tmp_path / "given"), atol=0.1)


def test_lens_is_fitted_alike_in_map_coordinates(tmp_path: Path) -> None:
    write_rail(tmp_path / "near", 1.0)
    model = pycolmap.Reconstruction(str(tmp_path / "near"))
    far = np.array([512345.6, 5403210.9, 310.2])
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), far))
    (tmp_path / "far").mkdir()
    model.write_binary(str(tmp_path / "far"))
    near, moved = (adjust_principal_points(tmp_path / n, tmp_path / f"{n}_found") for n in ("near", "far"))
    assert near is not None and moved is not None
    for name in ("reprojection_px_before", "reprojection_px", "shift_px_median"):
        np.testing.assert_allclose(moved[name], near[name], rtol=0.02)
    off = centres(tmp_path / "far_found") - centres(tmp_path / "near_found")
    np.testing.assert_allclose(off, np.broadcast_to(far, off.shape), atol=1e-3)


@pytest.mark.exhaustive
@pytest.mark.heavy
def test_lens_fit_runs_during_reconstruction_and_resumes(moved: Path, tmp_path: Path) -> None:
    output, events = tmp_path / "run", list[Event]()
    config = resolve_config("fast", settings={"exports": ()}, assignments=SETTINGS)
    reconstruct_until("lenses", moved, output, config)
    assert not (output / "poses").exists()
    reconstruct(moved, output, config, resume=True, progress=events.append)
    stages = [event.stage for event in events if isinstance(event, PhaseFinished)]
    assert stages == ["load", "lenses", "load", "train", "evaluate", "export"]
    assert any("lens moved" in event.message for event in events if isinstance(event, Warned))
    metrics = json.loads((output / "metrics.json").read_text())
    assert metrics["poses"]["lenses"]["shift_px_median"] > 5
    cameras = json.loads((output / "views.json").read_text())["cameras"]
    assert len(cameras) == VIEWS

    config = resolve_config(
        "fast", settings={"exports": ()}, assignments=[*SETTINGS, "per_view_principal_point=false"]
    )
    assert reconstruct_until("train", moved, tmp_path / "given", config) == ["load", "train"]
