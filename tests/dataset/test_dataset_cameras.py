import numpy as np
import pycolmap
import pytest

from octasplat.engine.dataset import Camera

CAMERAS = {
    "SIMPLE_PINHOLE": [500, 310, 250],
    "PINHOLE": [500, 510, 250, 300],  # principal point far off the centre
    "SIMPLE_RADIAL": [500, 310, 250, -0.1],
    "RADIAL": [500, 310, 250, -0.1, 0.02],
    "OPENCV": [500, 510, 310, 250, -0.1, 0.02, 0.001, -0.002],
    "FULL_OPENCV": [500, 510, 310, 250, -0.1, 0.02, 0.001, -0.002, 0.001, 0.01, 0.002, 0.001],
    "SIMPLE_RADIAL_FISHEYE": [500, 310, 250, -0.05],
    "RADIAL_FISHEYE": [500, 310, 250, -0.05, 0.01],
    "OPENCV_FISHEYE": [500, 510, 310, 250, -0.05, 0.01, 0.001, -0.001],
    "SIMPLE_FISHEYE": [500, 310, 250],
    "FISHEYE": [500, 510, 310, 250],
    "FOV": [500, 510, 310, 250, 0.5],
    "SIMPLE_DIVISION": [500, 310, 250, -0.1],
    "DIVISION": [500, 510, 310, 250, -0.1],
    "EUCM": [500, 510, 310, 250, 0.6, 1.1],
    "THIN_PRISM_FISHEYE": [500, 510, 310, 250, -0.05, 0.01, 0.001, -0.001, 0.001, 0.001, 0.001, 0.001],
    "RAD_TAN_THIN_PRISM_FISHEYE": [500, 510, 310, 250, *[0.01] * 6, *[0.001] * 6],
    "EQUIRECTANGULAR": [640, 480],
}


def camera(model: str) -> Camera:
    return Camera(model, tuple(float(p) for p in CAMERAS[model]), 640, 480)


def image_points(count: int = 400) -> np.ndarray:
    return np.random.default_rng(0).random((count, 2)) * [640, 480]


def test_all_colmap_camera_models_are_covered():
    assert set(CAMERAS) == set(pycolmap.CameraModelId.__members__) - {"INVALID"}


@pytest.mark.parametrize("model", CAMERAS)
def test_directions_project_back_onto_their_points(model):
    points = image_points()
    directions = camera(model).directions_cam(points)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    reference = pycolmap.Camera(model=model, width=640, height=480, params=CAMERAS[model])
    np.testing.assert_allclose(reference.img_from_cam(directions * 3.0), points, atol=1e-3)


@pytest.mark.parametrize("model", CAMERAS)
def test_scaling_is_exact_along_each_axis(model):
    points = image_points()
    # 640x480 to 200x151: the ratios differ, as they do after rounding to whole pixels.
    scaled = camera(model).scaled_to(200, 151)
    assert (scaled.width_px, scaled.height_px) == (200, 151)
    np.testing.assert_allclose(
        scaled.directions_cam(points * [200 / 640, 151 / 480]),
        camera(model).directions_cam(points),
        atol=1e-6,
    )


def test_pinhole_ray_has_known_direction():
    pinhole = Camera("PINHOLE", (100.0, 200.0, 10.0, 20.0), 64, 64)
    direction = pinhole.directions_cam(np.array([[110.0, 20.0], [10.0, 20.0]]))
    np.testing.assert_allclose(direction, [[np.sqrt(0.5), 0, np.sqrt(0.5)], [0, 0, 1]], atol=1e-15)


def test_points_beyond_the_field_of_view_have_no_direction():
    # COLMAP's fisheye un-projection answers wrongly, not with nan, beyond 90 degrees off the axis.
    fisheye = Camera("OPENCV_FISHEYE", (200.0, 200.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0), 640, 480)
    directions = fisheye.directions_cam(np.array([[0.5, 0.5], [320.0, 240.0]]))
    assert np.isnan(directions[0]).all()
    np.testing.assert_allclose(directions[1], [0, 0, 1])


def test_points_a_strong_distortion_never_reaches_have_no_direction():
    barrel = Camera("OPENCV", (500.0, 500.0, 320.0, 240.0, -1.9, 0.0, 0.0, 0.0), 640, 480)
    directions = barrel.directions_cam(np.array([[0.5, 0.5], [330.0, 240.0]]))
    assert np.isnan(directions[0]).all()
    assert np.isfinite(directions[1]).all()


def test_pixel_directions_of_no_points_are_empty():
    for model in CAMERAS:
        assert camera(model).directions_cam(np.empty((0, 2))).shape == (0, 3)


def test_distorted_camera_has_no_pinhole_parameters():
    with pytest.raises(ValueError, match="OPENCV is not a pinhole"):
        _ = camera("OPENCV").pinhole_params
