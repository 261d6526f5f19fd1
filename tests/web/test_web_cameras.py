"""The viewer's cameras, from COLMAP models in both forms."""

import io
import json
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from octasplat import viewer
from octasplat.engine.dataset.camera import Camera
from octasplat.engine.dataset.model import PosedView
from octasplat.engine.dataset.views_file import SplitViewpoints
from octasplat.engine.gaussians.frames import quaternions_from_matrices
from octasplat.engine.render.pose_paths import look_at
from octasplat.service.web.cameras import (
    MAX_VIEWS,
    CamerasUnreadableError,
    PhotographPose,
    read_poses,
    read_view_poses,
    viewer_cameras,
)
from octasplat.service.web.job_cameras import viewer_cameras_of_job

UP = np.array([0.0, 0.0, 1.0])
CENTRES = [(3.0, 0.0, 1.0), (0.0, 3.0, 2.0), (-3.0, 0.5, 1.5), (0.5, -3.0, 0.7)]
TARGET = np.array([0.2, -0.1, 0.4])
OBSERVATIONS = 3


def rotations() -> np.ndarray:
    """World to camera, all of them looking at one point with a level horizon."""
    return np.stack([look_at(np.array(centre), TARGET, UP)[:3, :3].T for centre in CENTRES])


def model(binary: bool) -> tuple[io.BytesIO, io.BytesIO]:
    """Two cameras, one of them with one focal length and one with two, and four photographs."""
    quats = quaternions_from_matrices(rotations())
    if not binary:
        cameras = "# a comment\n1 SIMPLE_RADIAL 400 300 500 200 150 0.1\n2 PINHOLE 300 400 310 320 150 200\n"
        lines = ["# a comment"]
        for k, (quat, centre) in enumerate(zip(quats, CENTRES, strict=True)):
            translation = -rotations()[k] @ np.array(centre)
            pose = " ".join(repr(float(v)) for v in [*quat, *translation])
            lines += [f"{k + 1} {pose} {1 + k % 2} a folder/view {9 - k}.jpg", "1.5 2.5 -1 3 4 17"]
        return io.BytesIO(cameras.encode()), io.BytesIO(("\n".join(lines) + "\n").encode())
    cameras_bin = struct.pack("<Q", 2)
    cameras_bin += struct.pack("<iiQQ4d", 1, 2, 400, 300, 500, 200, 150, 0.1)
    cameras_bin += struct.pack("<iiQQ4d", 2, 1, 300, 400, 310, 320, 150, 200)
    images = struct.pack("<Q", len(CENTRES))
    for k, (quat, centre) in enumerate(zip(quats, CENTRES, strict=True)):
        translation = -rotations()[k] @ np.array(centre)
        images += struct.pack("<i7di", k + 1, *quat, *translation, 1 + k % 2)
        images += f"a folder/view {9 - k}.jpg".encode() + b"\0" + struct.pack("<Q", OBSERVATIONS)
        images += bytes(24 * OBSERVATIONS)
    return io.BytesIO(cameras_bin), io.BytesIO(images)


@pytest.mark.parametrize("binary", [True, False])
def test_web_cameras_read_poses(binary: bool) -> None:
    poses = read_poses(*model(binary), binary=binary)
    assert [pose.name for pose in poses] == [f"a folder/view {k}.jpg" for k in (6, 7, 8, 9)]
    for pose, k in zip(poses, (3, 2, 1, 0), strict=True):
        np.testing.assert_allclose(pose.centre_world, CENTRES[k], atol=1e-6)
        np.testing.assert_allclose(pose.rotation_cam_from_world, rotations()[k], atol=1e-6)
        # The pixels of the second camera are not square.
        height, focal, aspect = ((300, 500, 4 / 3), (400, 320, 3 / 4 * 320 / 310))[k % 2]
        assert pose.fov_y_degrees == pytest.approx(np.degrees(2 * np.arctan(height / 2 / focal)))
        assert pose.aspect == pytest.approx(aspect)


@pytest.mark.parametrize("form", ["bin", "txt", "views.json"])
def test_every_camera_model_of_colmap_is_read(form: str) -> None:
    import pycolmap

    models = [name for name in pycolmap.CameraModelId.__members__ if name != "INVALID"]
    assert len(models) >= 18
    cameras, angles = [], []
    for k, name in enumerate(models):
        camera = pycolmap.Camera.create_from_model_name(k, name, 300.0, 400, 200)
        params = [*camera.params]
        for place in camera.focal_length_idxs()[-1:]:
            params[place] = 320.0  # along y, where there are two
        cameras.append((k, camera.model.value, name, params))
        angles.append(60.0 if name == "EQUIRECTANGULAR" else np.degrees(2 * np.arctan(200 / 2 / 320)))
    if form == "bin":
        records = [struct.pack(f"<iiQQ{len(p)}d", k, number, 400, 200, *p) for k, number, _, p in cameras]
        images = b"".join(
            struct.pack("<i7di", k, 1, *[0] * 6, k) + f"{k:02}.jpg\0".encode() + struct.pack("<Q", 0)
            for k in range(len(cameras))
        )
        count = struct.pack("<Q", len(cameras))
        poses = read_poses(io.BytesIO(count + b"".join(records)), io.BytesIO(count + images), binary=True)
    elif form == "txt":
        lines = [f"{k} {name} 400 200 {' '.join(map(str, p))}" for k, _, name, p in cameras]
        posed = [f"{k} 1 0 0 0 0 0 0 {k} {k:02}.jpg\n" for k in range(len(cameras))]
        poses = read_poses(
            io.BytesIO("\n".join(lines).encode()), io.BytesIO("\n".join(posed).encode()), binary=False
        )
    else:
        size = {"width_px": 400, "height_px": 200}
        placed = {"rotation_cam_from_world": np.eye(3), "translation_cam_from_world": np.zeros(3)}
        content = {
            "cameras": [{"model": name, "params": p, **size} for *_, name, p in cameras],
            "views": [{"name": f"{k:02}.jpg", "camera": k, **placed} for k in range(len(cameras))],
        }
        poses = read_view_poses(content)
    np.testing.assert_allclose([pose.fov_y_degrees for pose in poses], angles)
    assert [pose.is_panorama for pose in poses] == [name == "EQUIRECTANGULAR" for name in models]


def test_viewer_orbits_camera_focus() -> None:
    poses = read_poses(*model(True), binary=True)
    found = viewer_cameras(poses, ["a folder/view 7.jpg"])
    # Level cameras that look up and down by different angles: their mean up is not up, but what is square to
    # their right sides is.
    np.testing.assert_allclose(found["up"], UP, atol=1e-2)
    np.testing.assert_allclose(found["target"], TARGET, atol=2e-2)
    distances = [np.linalg.norm(np.array(centre) - TARGET) for centre in CENTRES]
    assert found["radius"] == pytest.approx(np.median(distances), rel=0.02)
    assert [view["held_out"] for view in found["views"]] == [False, True, False, False]


def test_parallel_cameras_have_something_ahead_to_turn_about() -> None:
    rotation = look_at(np.zeros(3), np.array([1.0, 0, 0]), UP)[:3, :3].T
    poses = [PhotographPose(f"{k}", rotation, np.array([0.0, float(k), 0.0]), 50.0, 1.5) for k in range(5)]
    found = viewer_cameras(poses)
    assert found["target"][0] > 0.5  # ahead
    np.testing.assert_allclose(found["up"], UP, atol=1e-6)


def test_viewer_cameras_thin_views_and_keep_held_out() -> None:
    rotation = np.eye(3)
    poses = [PhotographPose(f"{k:05}", rotation, np.zeros(3), 50.0, 1.5) for k in range(3000)]
    views = viewer_cameras(poses, ["00001"])["views"]
    assert len(views) <= MAX_VIEWS
    assert [view["name"] for view in views if view["held_out"]] == ["00001"]


@pytest.mark.parametrize("every", [0, 8, 7, 2])
@pytest.mark.parametrize("count", [401, 1000, 3001])
def test_viewer_cameras_come_from_all_over_many_photographs(count: int, every: int) -> None:
    poses = [PhotographPose(f"{k:05}", np.eye(3), np.zeros(3), 50.0, 1.5) for k in range(count)]
    held = [pose.name for k, pose in enumerate(poses) if every and k % every == 3 % every]
    views: Any = viewer_cameras(poses, held)["views"]
    names = [int(view["name"]) for view in views]
    assert len(names) == MAX_VIEWS and names == sorted(set(names))
    gaps = np.diff([-1, *names, count])
    assert gaps.max() <= 2.5 * count / MAX_VIEWS + 1
    kept = sum(view["held_out"] for view in views)
    assert kept >= min(len(held), MAX_VIEWS // 2)


@pytest.mark.parametrize("cut", [0, 7, 20, 60, 300])
def test_files_cut_short_are_refused(cut: int) -> None:
    cameras, images = model(True)
    with pytest.raises(CamerasUnreadableError):
        read_poses(cameras, io.BytesIO(images.getvalue()[:cut]), binary=True)


def test_hostile_counts_and_names_are_refused() -> None:
    cameras, images = model(True)
    for data in (
        struct.pack("<Q", 1 << 60),
        struct.pack("<Q", 2) + struct.pack("<i7di", 1, *range(7), 1) + b"x" * 9000,
    ):
        cameras.seek(0)
        with pytest.raises(CamerasUnreadableError):
            read_poses(cameras, io.BytesIO(data), binary=True)
    with pytest.raises(CamerasUnreadableError):
        read_poses(io.BytesIO(struct.pack("<QiiQQ", 1, 1, 99, 4, 3)), images, binary=True)


def test_invalid_poses_are_omitted() -> None:
    lines = ["1 0 0 0 0 0 0 0 1 zero.jpg", "2 1 0 0 0 nan 0 0 1 nan.jpg", "3 1 0 0 0 0 0 0 9 lost.jpg"]
    text = "\n\n".join([*lines, "4 1 0 0 0 0 0 0 1 good.jpg", ""]).encode()
    poses = read_poses(io.BytesIO(b"1 PINHOLE 4 3 2 2 2 2\n"), io.BytesIO(text), binary=False)
    assert [pose.name for pose in poses] == ["good.jpg"]


@pytest.mark.real
def test_web_cameras_of_real_model_match_pycolmap(scenes_root: Path) -> None:
    import pycolmap

    folder = scenes_root / "fox" / "sparse" / "0"
    if not (folder / "images.bin").exists():
        pytest.skip("there is no fox")
    with (folder / "cameras.bin").open("rb") as cameras, (folder / "images.bin").open("rb") as images:
        poses = {pose.name: pose for pose in read_poses(cameras, images, binary=True)}
    reconstruction = pycolmap.Reconstruction(str(folder))
    assert len(poses) == reconstruction.num_images()
    for image in reconstruction.images.values():
        np.testing.assert_allclose(poses[image.name].centre_world, image.projection_center(), atol=1e-6)


class StoredViews:
    """A storage that holds the views of a run."""

    def __init__(self, **camera: Any) -> None:
        size = {"width_px": 400, "height_px": 300}
        self.camera = {"model": "PINHOLE", "params": [300, 300, 200, 150], **size, **camera}

    def read(self, sha256: str) -> list[bytes]:
        views = [
            {
                "name": f"{k}.jpg",
                "camera": 0,
                "rotation_cam_from_world": rotation.tolist(),
                "translation_cam_from_world": (-rotation @ np.array(centre)).tolist(),
            }
            for k, (rotation, centre) in enumerate(zip(rotations(), CENTRES, strict=True))
        ]
        assert sha256 == "views"
        return [json.dumps({"cameras": [self.camera], "views": views}).encode()]


def test_cameras_of_a_job_on_a_transforms_file_are_those_of_its_result() -> None:
    row = SimpleNamespace(name="views.json", sha256="views", size_bytes=1000)
    files = [SimpleNamespace(path="transforms.json", sha256="poses", size_bytes=1000)]
    service = SimpleNamespace(storage=StoredViews())
    found = viewer_cameras_of_job(service, [row], files, None)["views"]  # type: ignore[arg-type]
    places = {view["name"]: view["position"] for view in found}
    for k, centre in enumerate(CENTRES):
        np.testing.assert_allclose(places[f"{k}.jpg"], centre, atol=1e-4)
    assert viewer_cameras_of_job(service, [], files, None) == {"views": []}  # type: ignore[arg-type]


def test_panoramas_are_told_from_photographs_with_edges() -> None:
    row: Any = SimpleNamespace(name="views.json", sha256="views", size_bytes=1000)
    kinds = []
    for camera in ({}, {"model": "EQUIRECTANGULAR", "params": [400, 200], "height_px": 200}):
        service: Any = SimpleNamespace(storage=StoredViews(**camera))
        views: Any = viewer_cameras_of_job(service, [row], [], None)["views"]
        kinds.append([view["panorama"] for view in views])
        assert all(0 < view["fov_y_degrees"] < 90 and view["aspect"] > 0 for view in views)
    assert kinds == [[False] * 4, [True] * 4]


def test_view_of_a_run_knows_panoramas_and_pixels_that_are_not_square(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cameras = (
        Camera("PINHOLE", (300.0, 330.0, 200.0, 100.0), 400, 200),
        Camera("EQUIRECTANGULAR", (400.0, 200.0), 400, 200),
    )
    views = tuple(PosedView(f"{k}.jpg", k, np.eye(3), np.zeros(3), 400, 200) for k in range(2))
    split = np.array([0]), np.array([1])
    monkeypatch.setattr(viewer, "run_viewpoints", lambda run: SplitViewpoints(views, cameras, *split, 1.0))
    found: Any = viewer._run_cameras(Path("run"))["views"]
    assert [view["panorama"] for view in found] == [False, True]
    assert found[0]["aspect"] == pytest.approx(2 * 330 / 300)
