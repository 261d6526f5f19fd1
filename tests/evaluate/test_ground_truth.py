"""Scenes against what is known of them: the format of truth.json, and measures with known answers."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.core.errors import ConfigError, DatasetError
from octasplat.engine.core.rays import ImageRays
from octasplat.engine.evaluate.ground_truth import find_ground_truth, read_ground_truth
from octasplat.engine.evaluate.ground_truth_measures import GroundTruthMeasures, measure_relit
from octasplat.engine.evaluate.ground_truth_metrics import (
    environment_errors,
    fit_channel_scales,
    normal_angles_degrees,
    to_display,
)
from octasplat.engine.pathtracing.environment import EnvironmentMap, environment_frame
from octasplat.engine.pathtracing.relighting.relighter import RelitImage
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.renderer import RenderedImage

SIDE = 8
UP = np.array([0.0, 0.0, 1.0])
TEXT = {
    "name": "a wall",
    "world": {"up": "+z"},
    "environment": {"train": "day", "relight": ["night"], "exposure": 1.0},
    "test": {
        "truth_views": ["a.png"],
        "mask": "255 where the ray hits",
        "normal": "16-bit RGB PNG: n = v/65504*2-1; world axes",
        "depth": "16-bit PNG: z along the axis = v/65535*8.0; 0 outside",
        "albedo": "8-bit RGB, sRGB curve",
        "roughness": "8-bit, v/255",
        "metallic": "8-bit, v/255",
    },
    "relight": {"folders": ["relight/night"], "views": ["a.png"]},
}


def save(path: Path, values: np.ndarray, kind: str = "uint8") -> None:
    """Write integers as they are."""
    path.parent.mkdir(parents=True, exist_ok=True)
    values = np.ascontiguousarray(values if values.ndim == 3 else values[..., None], kind)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), oiio.ImageSpec(SIDE, SIDE, values.shape[2], kind))
    assert output.write_image(values)
    output.close()


@pytest.fixture
def truth_folder(tmp_path) -> Path:
    """A wall of metal and plaster that the left half of a picture shows, 4 units in front of the camera."""
    (tmp_path / "truth.json").write_text(json.dumps(TEXT))
    left = np.zeros((SIDE, SIDE), bool)
    left[:, : SIDE // 2] = True
    test = tmp_path / "test"
    save(test / "mask" / "a.png", left * 255)
    normal = np.where(left[..., None], [32752 + 0, 32752, 0], 0)  # -z: 0 / 65504 * 2 - 1 = -1
    save(test / "normal" / "a.png", normal, "uint16")
    save(test / "depth" / "a.png", left * round(4.0 / 8.0 * 65535), "uint16")
    grey = round(float(linear_to_srgb(np.array(0.5))) * 255)
    save(test / "albedo" / "a.png", np.where(left[..., None], [grey] * 3, 0))
    save(test / "roughness" / "a.png", left * 51)
    save(test / "metallic" / "a.png", left * 255)
    return test


def wall(*, tilt_degrees: float, depth: float, albedo: float, roughness: float, metallic: float):
    """A render of that wall, seen along z from the origin, and the camera's rays."""
    rays = PinholeCamera.from_pose(np.eye(4), SIDE, SIDE, fy_px=2.0 * SIDE).rays()
    alpha = np.zeros((SIDE, SIDE), np.float32)
    alpha[:, : SIDE // 2] = 1.0
    tilt = math.radians(tilt_degrees)
    normal = np.array([math.sin(tilt), 0.0, -math.cos(tilt)], np.float32) * alpha[..., None]
    distance = depth / rays.directions_world[..., 2] * alpha
    rgb = np.zeros((SIDE, SIDE, 3), np.float32)
    names = {"albedo": [albedo] * 3, "metallic": [metallic], "roughness": [roughness]}
    layers = {name: np.array(values, np.float32) * alpha[..., None] for name, values in names.items()}
    return RenderedImage(rgb, alpha, distance, distance, normal, layers), rays


def measured(folder: Path, image: RenderedImage, rays: ImageRays) -> dict:
    truth = find_ground_truth(folder)
    assert truth is not None
    measures = GroundTruthMeasures(truth)
    measures.add("a.png", image, rays, np.array([0.0, 0.0, 1.0]))
    measures.add("unknown.png", image, rays, np.array([0.0, 0.0, 1.0]))
    return measures.as_dict()


def test_ground_truth_errors_equal_known_offsets(truth_folder):
    image, rays = wall(tilt_degrees=10, depth=4.25, albedo=0.25, roughness=0.5, metallic=0.75)
    found = measured(truth_folder, image, rays)
    mean = found["mean"]
    assert mean["normal_mae"] == pytest.approx(10.0, abs=0.01)
    assert mean["depth_mae"] == pytest.approx(0.25, abs=1e-3)
    assert mean["roughness_mae"] == pytest.approx(0.3, abs=1e-5)
    assert mean["metallic_mae"] == pytest.approx(0.25, abs=1e-5)
    assert mean["mask_iou"] == 1.0
    difference = float(linear_to_srgb(np.array(0.5)) - linear_to_srgb(np.array(0.25)))
    assert mean["albedo_psnr"] == pytest.approx(-20 * math.log10(difference), abs=0.1)
    assert mean["albedo_psnr_scaled"] > 70
    assert mean["albedo_scales"] == pytest.approx([2.0] * 3, rel=0.01)
    assert list(found["views"]) == ["a.png"]
    assert set(mean) - {"albedo_scales"} <= set(found["definitions"])


def test_scene_without_materials_has_only_normals_and_depth(truth_folder):
    image, rays = wall(tilt_degrees=0, depth=4.0, albedo=0.0, roughness=0.0, metallic=0.0)
    mean = measured(truth_folder, replace(image, layers={}), rays)["mean"]
    assert set(mean) == {"normal_mae", "depth_mae", "mask_iou"}
    assert mean["normal_mae"] < 0.01 and mean["depth_mae"] < 1e-3


def test_normal_error_of_missing_normal_is_90_degrees():
    true = np.tile([0.0, 0.6, 0.8], (2, 1))
    assert normal_angles_degrees(np.array([[0.0, 0, 0], [0, -0.6, -0.8]]), true) == pytest.approx([90, 180])


def test_smaller_pictures_take_the_nearest_pixels_and_other_shapes_are_refused(truth_folder):
    truth = find_ground_truth(truth_folder)
    small = truth.view("a.png", (SIDE // 2, SIDE // 2))
    assert (small.mask[:, : SIDE // 4]).all() and not small.mask[:, SIDE // 4 :].any()
    with pytest.raises(DatasetError, match=r"a\.png has 8 x 8"):
        truth.view("a.png", (SIDE, SIDE // 2))


def test_truth_is_found_in_or_beside_a_folder(truth_folder, tmp_path):
    assert find_ground_truth(truth_folder).path == tmp_path / "truth.json"
    assert find_ground_truth(tmp_path).path == tmp_path / "truth.json"
    (tmp_path / "images").mkdir()
    assert find_ground_truth(tmp_path / "images") is None
    truth = find_ground_truth(truth_folder)
    assert truth.environment == tmp_path / "env" / "day.hdr"
    assert truth.relit_folders == ((tmp_path / "relight" / "night", tmp_path / "env" / "night.hdr"),)
    assert truth.up_world.tolist() == UP.tolist()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"test": {"truth_views": []}}, "truth_views"),
        ({"test": {"truth_views": ["a.png"], "depth": "as measured"}}, "formula"),
        ({"test": {"truth_views": ["../a.png"]}}, "below the folder"),
        ({"world": {"up": "north"}}, "up is one of"),
        ({"test": None}, "test"),
    ],
)
def test_ground_truth_unknown_format_is_refused(tmp_path, change, told):
    (tmp_path / "truth.json").write_text(json.dumps({**TEXT, **change}))
    with pytest.raises(ConfigError) as error:
        read_ground_truth(tmp_path / "truth.json")
    assert str(tmp_path / "truth.json") in str(error.value) and told in str(error.value)


def test_ground_truth_channel_scale_with_clipped_values_is_found():
    random = np.random.default_rng(0)
    true = random.random((500, 3)) * 1.4
    scales = np.array([0.25, 1.0, 3.0])
    assert fit_channel_scales(true / scales, true, to_display) == pytest.approx(scales, rel=1e-3)


def test_environment_is_compared_in_same_world():
    random = np.random.default_rng(1)
    blobs = np.repeat(np.repeat(random.random((4, 8, 3)), 4, axis=0), 4, axis=1).astype(np.float32)
    true = EnvironmentMap(blobs, environment_frame(UP))
    raw, scaled, scales = environment_errors(true, true)
    assert raw > 100 and scaled > 100 and scales == pytest.approx([1, 1, 1], abs=1e-3)
    tinted = EnvironmentMap(blobs * np.float32([0.5, 1, 2]), environment_frame(UP))
    raw, scaled, scales = environment_errors(tinted, true)
    assert raw < 30 and scaled > 60 and scales == pytest.approx([2, 1, 0.5], rel=1e-3)
    # The same light from a map that is turned by a quarter and whose columns are turned back.
    turned = EnvironmentMap(np.roll(blobs, 8, axis=1), environment_frame(UP, 90.0))
    assert environment_errors(turned, true)[0] > 100


def test_relit_pictures_share_one_factor_a_channel():
    random = np.random.default_rng(2)
    linear = [random.random((6, 6, 3)) * 0.5 for _ in range(4)]
    names = [("day", "a"), ("day", "b"), ("night", "a"), ("night", "b")]
    alpha = np.ones((6, 6, 1))
    true = [np.concatenate([to_display(image), alpha], axis=-1).astype(np.float32) for image in linear]
    whole = np.ones((6, 6), np.float32)
    dark = [RelitImage((image * [0.5, 0.25, 1.0]).astype(np.float32), whole) for image in linear]
    found = measure_relit(dark, true, names)
    assert found["relight_scales"] == pytest.approx([2, 4, 1], rel=1e-3)
    assert found["relight_psnr"] < 25 and found["relight_psnr_scaled"] > 60
    assert set(found["relight"]) == {"day", "night"} and found["relight"]["day"]["views"] == 2


@pytest.mark.parametrize("factor", [1e-4, 1e4])
def test_channel_scales_stay_within_their_range(factor):
    true = np.random.default_rng(0).random((100, 3))
    scales = fit_channel_scales(true / factor, true, lambda values: values)
    assert (scales >= 1 / 256).all() and (scales <= 256).all()
    assert scales == pytest.approx(np.clip(factor, 1 / 256, 256), rel=1e-3)
