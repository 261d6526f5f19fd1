import shutil
import unicodedata

import numpy as np
import pycolmap
import pytest

from octasplat.engine.core.errors import ConfigError, DatasetError
from octasplat.engine.dataset import load_dataset_model

MODEL_FILES = ["cameras", "images", "points3D"]


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize("with_rigs", [False, True], ids=["before rigs", "with rigs"])
@pytest.mark.parametrize("folder", ["sparse/0", "sparse", "colmap/sparse/0"])
def test_dataset_loads_all_model_formats(tmp_path, make_scene, text, with_rigs, folder):
    root = make_scene(tmp_path, text=text, with_rigs=with_rigs, folder=folder)
    scene = load_dataset_model(root)
    assert scene.model_folder == root / folder
    assert [view.name for view in scene.views] == [f"view_{i}.png" for i in range(4)]
    assert [(view.width_px, view.height_px) for view in scene.views] == [(32, 24)] * 4
    assert scene.cameras[0].params == (30.0, 31.0, 16.0, 12.0)
    for index, view in enumerate(scene.views):
        angle = 0.7 * index
        np.testing.assert_allclose(view.origin_world, [4 * np.cos(angle), 1.2, 4 * np.sin(angle)], atol=1e-9)
        # The cameras look at the origin, which lies in front of them.
        at_origin = view.rotation_cam_from_world @ np.zeros(3) + view.translation_cam_from_world
        np.testing.assert_allclose(at_origin / at_origin[2], [0, 0, 1], atol=1e-9)
        assert at_origin[2] > 0
    assert len(scene.points) == 20
    assert scene.points.track_lengths.tolist() == [2] * 20
    order = np.argsort(scene.points.rgb_srgb[:, 0])
    np.testing.assert_allclose(scene.points.rgb_srgb[order, 0], np.arange(20) / 255, atol=1e-7)
    assert (scene.points.rgb_srgb[:, 1:] == [1.0, 0.0]).all()
    assert scene.warnings == ()


def test_poses_of_a_rig_are_composed(tmp_path, make_scene):
    root = make_scene(tmp_path)
    shutil.rmtree(root / "sparse")
    model = pycolmap.Reconstruction()
    for camera_id in (1, 2):
        model.add_camera(
            pycolmap.Camera(
                camera_id=camera_id, model="SIMPLE_PINHOLE", width=32, height=24, params=[30, 16, 12]
            )
        )
    rig = pycolmap.Rig(rig_id=1)
    rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 1))
    sideways = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-0.5, 0.0, 0.0]))
    rig.add_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, 2), sideways)
    model.add_rig(rig)
    for pair in range(2):
        frame = pycolmap.Frame(frame_id=pair + 1, rig_id=1)
        for side in range(2):
            sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, side + 1)
            frame.add_data_id(pycolmap.data_t(sensor, 2 * pair + side + 1))
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([0.0, 0.0, float(pair)]))
        model.add_frame(frame)
        for side in range(2):
            index = 2 * pair + side
            model.add_image(
                pycolmap.Image(
                    name=f"view_{index}.png", camera_id=side + 1, image_id=index + 1, frame_id=pair + 1
                )
            )
        model.register_frame(pair + 1)
    (root / "sparse/0").mkdir(parents=True)
    model.write_binary(str(root / "sparse/0"))
    origins = [view.origin_world.tolist() for view in load_dataset_model(root).views]
    assert origins == [[0, 0, 0], [0.5, 0, 0], [0, 0, -1], [0.5, 0, -1]]


def test_nested_folders_and_odd_names(tmp_path, make_scene, coded):
    names = ["links/Gärten 1.png", "rechts/Gärten 1.png", "rechts/tief unten/ß.png"]
    root = make_scene(
        tmp_path / "Übung mit Leerzeichen",
        images=[(name, 0, coded(32, 24, i)) for i, name in enumerate(names)],
    )
    scene = load_dataset_model(root)
    assert [view.name for view in scene.views] == names
    assert all(view.image_path.is_file() for view in scene.views)


def test_a_link_back_into_the_photographs_shows_none_of_them_twice(tmp_path, make_scene):
    root = make_scene(tmp_path / "scene")
    (root / "images" / "again").symlink_to(".")
    (root / "images" / "above").symlink_to("../..")
    other = make_scene(tmp_path / "other")
    (root / "masks").symlink_to(other / "images")
    scene = load_dataset_model(root)
    assert [view.name for view in scene.views] == [f"view_{i}.png" for i in range(4)]
    unposed = [text for text in scene.warnings if "have no pose" in text]
    assert all("again" not in text for text in unposed)
    # What the link above leads to is there once: the other scene's photographs.
    assert len(unposed) == 1 and unposed[0].startswith("4 images in")


def test_dataset_unicode_names_match_across_normal_forms(tmp_path, make_scene):
    root = make_scene(tmp_path)
    (root / "images/view_1.png").rename(root / "images" / unicodedata.normalize("NFD", "ü.png"))
    replace_name(root, "view_1.png", unicodedata.normalize("NFC", "ü.png"))
    assert load_dataset_model(root).views[-1].name == "ü.png"


def replace_name(root, old: str, new: str) -> None:
    model = pycolmap.Reconstruction(str(root / "sparse/0"))
    for image in model.images.values():
        if image.name == old:
            image.name = new
    model.write_binary(str(root / "sparse/0"))


def test_several_cameras_and_sizes(tmp_path, make_scene, coded):
    cameras = [
        pycolmap.Camera(model="PINHOLE", width=32, height=24, params=[30, 31, 16, 12]),
        pycolmap.Camera(model="OPENCV", width=40, height=20, params=[30, 31, 20, 10, -0.1, 0, 0, 0]),
        pycolmap.Camera(model="PINHOLE", width=32, height=24, params=[30, 31, 16, 12]),
    ]
    images = [
        ("a.png", 0, coded(32, 24, 0)),
        ("b.png", 1, coded(40, 20, 1)),
        ("c.png", 2, coded(32, 24, 2)),
        ("d.png", 0, coded(16, 12, 3)),  # downscaled by the user
    ]
    scene = load_dataset_model(make_scene(tmp_path, cameras=cameras, images=images))
    assert [view.camera_index for view in scene.views] == [0, 1, 0, 2]
    assert [camera.model for camera in scene.cameras] == ["PINHOLE", "OPENCV", "PINHOLE"]
    assert scene.cameras[2].params == (15.0, 15.5, 8.0, 6.0)


def test_max_side_scales_cameras_by_exact_ratio(tmp_path, make_scene):
    scene = load_dataset_model(make_scene(tmp_path), max_side=11)
    assert (scene.views[0].width_px, scene.views[0].height_px) == (11, 8)
    np.testing.assert_allclose(scene.cameras[0].params, (30 * 11 / 32, 31 * 8 / 24, 5.5, 4.0))
    unchanged = load_dataset_model(tmp_path, max_side=100)
    assert unchanged.cameras[0].width_px == 32


def test_dataset_unusual_input_warns(tmp_path, make_scene, save_image, coded):
    cameras = [
        pycolmap.Camera(model="PINHOLE", width=32, height=24, params=[30, 31, 16, 12]) for _ in range(3)
    ]
    root = make_scene(tmp_path, cameras=cameras, points=0)
    save_image(root / "images/extra.png", coded(32, 24, 9))
    (root / "images/notes.txt").write_text("not an image")
    (root / "images/.hidden.png").write_text("not an image")
    shutil.copytree(root / "sparse/0", root / "sparse/1")
    save_image(root / "masks/view_0.png.png", np.full((24, 32), 255, np.uint8))
    warnings = "\n".join(load_dataset_model(root).warnings)
    assert "2 cameras" in warnings
    assert "1 images" in warnings and "extra.png" in warnings and "notes" not in warnings
    assert "no 3D points" in warnings
    assert str(root / "sparse") in warnings and "further models (1)" in warnings
    assert "3 images have no mask" in warnings and "view_1.png" in warnings


def test_dataset_unmatched_masks_warn(tmp_path, make_scene, save_image):
    root = make_scene(tmp_path)
    save_image(root / "masks/mask_0.png", np.full((24, 32), 255, np.uint8))
    scene = load_dataset_model(root)
    assert "view_0.png.png" in scene.warnings[0]
    assert all(view.mask_path is None for view in scene.views)


def test_dataset_truncated_points_text_warns(tmp_path, make_scene):
    root = make_scene(tmp_path, text=True)
    path = root / "sparse/0/points3D.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:-5]))
    assert f"{path} announces 20 points but holds 15" in load_dataset_model(root).warnings[0]


def test_missing_folders_are_named(tmp_path, make_scene):
    with pytest.raises(DatasetError, match="nowhere is not a folder"):
        load_dataset_model(tmp_path / "nowhere")
    with pytest.raises(DatasetError, match="no folder images"):
        load_dataset_model(tmp_path)
    root = make_scene(tmp_path)
    shutil.rmtree(root / "sparse")
    with pytest.raises(DatasetError, match=r"no COLMAP model.*sparse/0"):
        load_dataset_model(root)


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize("part", MODEL_FILES)
def test_incomplete_model_is_named(tmp_path, make_scene, part, text):
    root = make_scene(tmp_path, text=text)
    name = f"{part}{'.txt' if text else '.bin'}"
    (root / "sparse/0" / name).unlink()
    with pytest.raises(DatasetError, match=f"sparse/0 lacks {name}"):
        load_dataset_model(root)


@pytest.mark.parametrize("keep", [0.0, 0.3, 0.7, 0.99])
@pytest.mark.parametrize("part", [*MODEL_FILES, "rigs", "frames"])
def test_dataset_truncated_binary_model_is_named(tmp_path, make_scene, part, keep):
    root = make_scene(tmp_path)
    path = root / "sparse/0" / f"{part}.bin"
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])
    with pytest.raises(DatasetError, match=f"{part}.bin is damaged"):
        load_dataset_model(root)


def test_dataset_binary_model_with_trailing_bytes_is_named(tmp_path, make_scene):
    root = make_scene(tmp_path)
    with (root / "sparse/0/points3D.bin").open("ab") as handle:
        handle.write(b"rest")
    with pytest.raises(DatasetError, match=r"points3D\.bin is damaged"):
        load_dataset_model(root)


def test_dataset_huge_record_count_is_refused(tmp_path, make_scene):
    root = make_scene(tmp_path)
    path = root / "sparse/0/points3D.bin"
    data = bytearray(path.read_bytes())
    data[8 + 43 : 8 + 51] = b"\xff" * 8  # length of the first track
    path.write_bytes(data)
    with pytest.raises(DatasetError, match=r"points3D\.bin is damaged"):
        load_dataset_model(root)


def test_unknown_camera_model_is_named(tmp_path, make_scene):
    root = make_scene(tmp_path)
    path = root / "sparse/0/cameras.bin"
    data = bytearray(path.read_bytes())
    data[12:16] = (77).to_bytes(4, "little")
    path.write_bytes(data)
    with pytest.raises(DatasetError, match=r"cameras\.bin names the camera model number 77"):
        load_dataset_model(root)


def test_nonsense_in_a_text_file_is_refused(tmp_path, make_scene):
    root = make_scene(tmp_path, text=True)
    path = root / "sparse/0/images.txt"
    path.write_text(path.read_text().replace("1", "x"))
    with pytest.raises(DatasetError, match=r"sparse/0/\w+\.txt holds '\S*x\S*' where a finite number"):
        load_dataset_model(root)


def test_poses_must_be_finite(tmp_path, make_scene):
    root = make_scene(tmp_path, with_rigs=False)
    path = root / "sparse/0/images.bin"
    data = bytearray(path.read_bytes())
    data[8 + 4 + 32 : 8 + 4 + 40] = np.float64(np.nan).tobytes()  # x of the first translation
    path.write_bytes(data)
    with pytest.raises(DatasetError, match=r"pose of view_\d\.png"):
        load_dataset_model(root)


def set_quaternion(root, wxyz: list[float], text: bool) -> None:
    """Replace the rotation of the first image of a model without rigs."""
    path = root / "sparse/0" / ("images.txt" if text else "images.bin")
    if text:
        lines = path.read_text().splitlines()
        first = next(number for number, line in enumerate(lines) if not line.startswith("#"))
        words = lines[first].split()
        lines[first] = " ".join([words[0], *(f"{value:g}" for value in wxyz), *words[5:]])
        path.write_text("\n".join(lines) + "\n")
    else:
        data = bytearray(path.read_bytes())
        data[12:44] = np.array(wxyz).tobytes()
        path.write_bytes(data)


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize("wxyz", [[0, 0, 0, 0], [1e-30, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1]])
def test_rotations_must_be_rotations(tmp_path, make_scene, wxyz, text):
    root = make_scene(tmp_path, with_rigs=False, text=text)
    set_quaternion(root, wxyz, text)
    with pytest.raises(DatasetError, match=r"pose of view_\d\.png"):
        load_dataset_model(root)


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize(("factor", "told"), [(2.5, True), (1 + 1e-5, False)])
def test_rotations_of_another_length_are_normalised(tmp_path, make_scene, factor, told, text):
    root = make_scene(tmp_path, with_rigs=False, text=text)
    quaternion = np.array([0.5, -0.1, 0.7, 0.5])  # of length 1
    set_quaternion(root, (factor * quaternion).tolist(), text)
    scene = load_dataset_model(root)
    set_quaternion(root, quaternion.tolist(), text)
    wanted = load_dataset_model(root)
    for view, other in zip(scene.views, wanted.views, strict=True):
        np.testing.assert_allclose(
            view.rotation_cam_from_world, other.rotation_cam_from_world, rtol=0, atol=2e-5 if text else 1e-12
        )
        np.testing.assert_allclose(np.linalg.det(view.rotation_cam_from_world), 1.0, atol=1e-12)
    assert any("1 rotations" in warning and "normalised" in warning for warning in scene.warnings) is told


def test_camera_parameters_must_be_possible(tmp_path, make_scene):
    root = make_scene(tmp_path)
    path = root / "sparse/0/cameras.bin"
    data = bytearray(path.read_bytes())
    data[32:40] = np.float64(-5).tobytes()
    path.write_bytes(data)
    with pytest.raises(DatasetError, match=r"Camera 1 .*impossible"):
        load_dataset_model(root)


def test_missing_photographs_are_counted_and_named(tmp_path, make_scene):
    root = make_scene(tmp_path, images=[(f"{i}.png", 0, None) for i in range(5)])
    with pytest.raises(DatasetError, match=r"5 of 5 .*0\.png, 1\.png, 2\.png, \.\.\."):
        load_dataset_model(root)


def test_names_cannot_lead_out_of_the_images_folder(tmp_path, make_scene):
    root = make_scene(tmp_path / "scene")
    shutil.copy(root / "images/view_0.png", tmp_path / "secret.png")
    replace_name(root, "view_0.png", "../../secret.png")
    with pytest.raises(DatasetError, match="secret"):
        load_dataset_model(root)


def test_three_views_are_needed(tmp_path, make_scene, coded):
    root = make_scene(tmp_path, images=[(f"{i}.png", 0, coded(32, 24, i)) for i in range(2)])
    with pytest.raises(DatasetError, match="2 posed images; at least 3"):
        load_dataset_model(root)


def test_sizes_of_another_shape_are_named(tmp_path, make_scene, save_image, coded):
    root = make_scene(tmp_path)
    save_image(root / "images/view_2.png", coded(32, 27, 2))
    with pytest.raises(DatasetError, match=r"view_2\.png is 32x27 but camera 1 of the model is 32x24"):
        load_dataset_model(root)
    save_image(root / "images/view_2.png", coded(16, 13, 2))  # half of it, rounded up
    load_dataset_model(root)


def test_dataset_rotated_photograph_is_explained(tmp_path, make_scene, save_image, coded):
    root = make_scene(tmp_path, images=[(f"{i}.jpg", 0, coded(32, 24, i)) for i in range(3)])
    save_image(root / "images/2.jpg", coded(24, 32, 2), Orientation=6)
    with pytest.raises(DatasetError, match=r"2\.jpg is 24x32 .*EXIF orientation"):
        load_dataset_model(root)


@pytest.mark.parametrize("content", [b"", b"no image at all"])
def test_non_image_file_is_named(tmp_path, make_scene, content):
    root = make_scene(tmp_path)
    (root / "images/view_3.png").write_bytes(content)
    with pytest.raises(DatasetError, match=r"view_3\.png cannot be read as an image"):
        load_dataset_model(root)


def test_max_side_must_be_positive(tmp_path, make_scene):
    with pytest.raises(ConfigError, match="max_side is 0"):
        load_dataset_model(make_scene(tmp_path), max_side=0)
