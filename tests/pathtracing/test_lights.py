"""Lights against closed forms: form factor, inverse square, cones, environments and their sampling."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from scipy.stats import chi2

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.pathtracing.compile_meshes import compile_meshes
from octasplat.engine.pathtracing.environment import EnvironmentMap, environment_frame
from octasplat.engine.pathtracing.lights import build_light_arrays, eval_environment_map
from octasplat.engine.pathtracing.stage.model import (
    DirectionalLight,
    Environment,
    PointLight,
    RectangleLight,
    SpotLight,
    Stage,
)
from octasplat.engine.render.environment_files import (
    read_environment,
    write_background_map,
    write_environment,
)
from octasplat.engine.render.image_files import write_exr
from octasplat.engine.shading.background import LearnedBackground
from tests.support.light_samples import sample_lights

UP = np.array([0.0, 0.0, 1.0])


def irradiance(samples, normal=UP):  # type: ignore[no-untyped-def]
    cosine = np.maximum(samples.directions_world @ normal, 0.0)[:, None]
    density = np.where(samples.density > 0, samples.density, 1.0)[:, None]
    return (samples.radiance_linear * cosine / density).mean(axis=0)


def stratified(side: int) -> np.ndarray:
    u, v = np.meshgrid((np.arange(side) + 0.5) / side, (np.arange(side) + 0.5) / side)
    rng = np.random.default_rng(0)
    return np.stack([rng.permutation(side * side) / side**2, u.ravel(), v.ravel()], axis=1)


def test_parallel_rectangle_form_factor() -> None:
    # A corner of a rectangle of sides a, b over a point at distance 1 has this form factor; there are four.
    a, b = 0.7, 1.2
    corner = (
        a / np.hypot(1, a) * np.arctan(b / np.hypot(1, a))
        + b / np.hypot(1, b) * np.arctan(a / np.hypot(1, b))
    ) / (2 * np.pi)
    light = RectangleLight(position=(0, 0, 1), direction=(0, 0, -1), width=2 * a, height=2 * b, radiance=3.0)
    samples = sample_lights(
        build_light_arrays((light,), np.array([0.0, 1.0, 0.0])), np.zeros((1 << 14, 3)), stratified(128)
    )
    # Which side is the level one follows from the up direction that the stage names.
    np.testing.assert_allclose(irradiance(samples), 4 * corner * np.pi * 3.0, rtol=2e-3)


@pytest.mark.parametrize("radius", [1e-30, 1e-200])
def test_ball_as_small_as_it_likes_lights_as_a_point(radius: float) -> None:
    point, ball = (PointLight(position=(0, 0, 0), intensity=3, radius=each) for each in (0.0, radius))
    points = np.random.default_rng(0).normal(size=(16, 3))
    wanted, found = (
        sample_lights(build_light_arrays((lamp,), UP), points, stratified(4)) for lamp in (point, ball)
    )
    for one, other in zip(wanted, found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_rectangle_light_back_side_is_black() -> None:
    light = RectangleLight(position=(0, 0, 1), direction=(0, 0, 1), width=1, height=1, radiance=3.0)
    assert (
        irradiance(sample_lights(build_light_arrays((light,), UP), np.zeros((16, 3)), stratified(4))) == 0
    ).all()


def test_points_fall_off_with_the_square_and_directional_lights_not() -> None:
    point = build_light_arrays((PointLight(position=(0, 0, 2), intensity=8.0),), UP)
    sun = build_light_arrays((DirectionalLight(direction=(1, 0, -1), irradiance=2.0),), UP)
    # A ball that is far and small, as a sun given by its place, lights as a point does.
    ball = build_light_arrays((PointLight(position=(0, 0, 2e7), intensity=8e14, radius=2.0),), UP)
    np.testing.assert_allclose(irradiance(sample_lights(ball, np.zeros((4, 3)), stratified(2))), 2.0)
    np.testing.assert_allclose(irradiance(sample_lights(point, np.zeros((4, 3)), stratified(2))), 2.0)
    np.testing.assert_allclose(
        irradiance(sample_lights(sun, np.full((4, 3), 9.0), stratified(2))), np.sqrt(2)
    )


def test_spot_light_is_limited_to_cone() -> None:
    spot = SpotLight(
        position=(0, 0, 1), direction=(0, 0, -1), intensity=1.0, outer_degrees=30, inner_degrees=10
    )
    angles = np.radians([0.0, 9.0, 20.0, 31.0])
    points = np.stack([np.tan(angles), 0 * angles, 0 * angles], axis=1)
    seen = sample_lights(build_light_arrays((spot,), UP), points, np.zeros((4, 3))).radiance_linear[:, 0]
    outer, inner = np.cos(np.radians([30, 10]))
    falloff = [1.0, 1.0, ((np.cos(angles[2]) - outer) / (inner - outer)) ** 2, 0.0]
    np.testing.assert_allclose(seen, falloff * np.cos(angles) ** 2, rtol=1e-12)


def test_several_lights_add_up() -> None:
    lights = (
        PointLight(position=(0, 0, 1), intensity=1.0),
        PointLight(position=(3, 0, 1), intensity=20.0, color_srgb=(1, 0, 0)),
        DirectionalLight(direction=(0, 0, -1), irradiance=0.5),
        RectangleLight(position=(0, 0, -1), direction=(0, 0, -1), width=1, height=1, radiance=9.0),
    )
    samples = sample_lights(build_light_arrays(lights, UP), np.zeros((1 << 14, 3)), stratified(128))
    expected = np.array([1.5 + 20 / 10**1.5, 1.5, 1.5])
    np.testing.assert_allclose(irradiance(samples), expected, rtol=5e-3)
    assert 3 not in samples.lights


def patchy() -> np.ndarray:
    radiance = np.full((16, 32, 3), 0.1, np.float32)
    radiance[3:5, 20:22] = 40.0
    radiance[9, 0] = (5.0, 1.0, 0.2)
    return radiance


def test_environment_sampling_density() -> None:
    frame = environment_frame(np.array([0.2, -1.0, 0.1]), 37.0)
    lights = build_light_arrays((), UP, EnvironmentMap(patchy(), frame))
    rows, columns = 256, 512
    v, u = np.meshgrid((np.arange(rows) + 0.5) / rows, (np.arange(columns) + 0.5) / columns, indexing="ij")
    local = np.stack(
        [
            np.sin(np.pi * v) * np.sin(2 * np.pi * (u - 0.5)),
            np.cos(np.pi * v),
            np.sin(np.pi * v) * np.cos(2 * np.pi * (u - 0.5)),
        ],
        axis=-1,
    )
    patches = 2 * np.pi**2 * np.sin(np.pi * v) / v.size
    radiance, density = eval_environment_map(lights, (local @ frame).reshape(-1, 3))
    assert abs((density * patches.ravel()).sum() - 1) < 1e-3
    n = 100_000
    samples = sample_lights(lights, np.zeros((n, 3)), np.random.default_rng(1).random((n, 3)))
    again, density_there = eval_environment_map(lights, samples.directions_world)
    np.testing.assert_allclose(samples.density, density_there, rtol=1e-6)
    np.testing.assert_allclose(samples.radiance_linear, again, rtol=1e-6)
    back = samples.directions_world @ frame.T
    polar = np.arccos(np.clip(back[:, 1], -1, 1)) / np.pi
    around = 0.5 + np.arctan2(back[:, 0], back[:, 2]) / (2 * np.pi)
    counted = np.histogram2d(polar, around, bins=(16, 32), range=((0, 1), (0, 1)))[0]
    expected = n * (density * patches.ravel()).reshape(16, 16, 32, 16).sum(axis=(1, 3))
    used = expected > 10
    assert (((counted - expected) ** 2 / expected)[used]).sum() < chi2.ppf(0.9999, used.sum())
    # The light that falls on a surface, by its samples and by a sum over the sphere.
    normal = np.array([0.0, -0.6, 0.8])
    summed = (
        radiance * np.maximum((local @ frame).reshape(-1, 3) @ normal, 0)[:, None] * patches.reshape(-1, 1)
    ).sum(axis=0)
    np.testing.assert_allclose(irradiance(samples, normal), summed, rtol=0.02)


def test_environment_rotation_turns_map() -> None:
    radiance = np.zeros((64, 128, 3), np.float32)
    radiance[31:33, 63:65] = 1.0  # the middle
    radiance[:4] = 0.5  # the top
    colmap = build_light_arrays(
        (), UP, EnvironmentMap(radiance, environment_frame(np.array([0.0, -1.0, 0.0])))
    )
    assert eval_environment_map(colmap, np.array([[0.0, 0.0, 1.0]]))[0][0, 0] == 1.0
    assert eval_environment_map(colmap, np.array([[0.0, -1.0, 0.0]]))[0][0, 0] == 0.5
    level = build_light_arrays((), UP, EnvironmentMap(radiance, environment_frame(UP)))
    assert eval_environment_map(level, np.array([[1.0, 0.0, 0.0]]))[0][0, 0] == 1.0
    turned = build_light_arrays((), UP, EnvironmentMap(radiance, environment_frame(UP, 90.0)))
    assert eval_environment_map(turned, np.array([[0.0, 1.0, 0.0]]))[0][0, 0] == pytest.approx(1.0)


def test_background_of_a_run_lies_in_a_tilted_stage_as_it_was_learnt(tmp_path: Path) -> None:
    learnt = LearnedBackground(16)
    write_background_map(tmp_path / "background.exr", learnt.rgb_srgb)
    tilted = (0.2, -0.9, 0.3)
    for up, frame in (((0.0, -1.0, 0.0), learnt.frame), (None, environment_frame(np.array(tilted)))):
        stage = Stage(up=tilted, environment=Environment(file="background.exr", up=up))
        lights = compile_meshes(stage, tmp_path, threads=1).lights
        np.testing.assert_allclose(lights.environment_frame, frame, atol=1e-12)


def test_environment_invalid_image_is_refused(tmp_path: Path) -> None:
    (tmp_path / "not.hdr").write_bytes(b"#?RADIANCE nonsense")
    with pytest.raises(ConfigError, match=r"not\.hdr"):
        read_environment(tmp_path / "not.hdr")
    with pytest.raises(ConfigError, match="HDR or EXR"):
        read_environment(tmp_path / "sky.png")
    bad = np.ones((4, 8), np.float32)
    bad[1, 1] = np.nan
    write_exr(tmp_path / "bad.exr", {"R": bad, "G": bad, "B": bad})
    with pytest.raises(ConfigError, match="not finite"):
        read_environment(tmp_path / "bad.exr")


def test_environment_odd_pixels_are_replaced_and_told(tmp_path: Path) -> None:
    values = np.full((4, 8), 2.0, np.float32)
    values[0, :4] = np.nan, -1.0, np.inf, -np.inf
    write_exr(tmp_path / "odd.exr", {"R": values, "G": values, "B": values}, half=False)
    told: list[str] = []
    radiance = read_environment(tmp_path / "odd.exr", told.append)
    np.testing.assert_array_equal(radiance[0, :4, 0], [0.0, 0.0, 2.0, 0.0])
    assert (radiance[1:] == 2.0).all() and len(told) == 1 and "4 of 32 pixels" in told[0]
    for name, shape, sentence in (
        ("square", (8, 8), "twice as wide as high"), ("black", (4, 8), "is black"),
    ):  # fmt: skip
        told.clear()
        light = np.full(shape, 0.0 if name == "black" else 1.0, np.float32)
        write_exr(tmp_path / f"{name}.exr", {"R": light, "G": light, "B": light})
        read_environment(tmp_path / f"{name}.exr", told.append)
        assert len(told) == 1 and sentence in told[0]


@pytest.mark.parametrize("axes", ["-Y +X", "-Y -X", "+Y -X", "+Y +X", "+X -Y", "+X +Y", "-X +Y", "-X -Y"])
def test_environment_is_turned_as_its_head_says(tmp_path: Path, axes: str) -> None:
    upright = np.arange(1, 9, dtype=np.uint8).reshape(2, 4) * 16
    # Y is up and X to the right: the file tells which way its lines, and the pixels of each, go
    stored = upright[:: 1 if "-Y" in axes else -1, :: 1 if "+X" in axes else -1]
    stored = stored.T if axes[1] == "X" else stored
    lines, pixels = (f"{axis} {count}" for axis, count in zip(axes.split(), stored.shape, strict=True))
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\n\n{lines} {pixels}\n"
    rgbe = np.stack([stored, stored, stored, np.full_like(stored, 128 + 8)], axis=-1)
    (tmp_path / "map.hdr").write_bytes(head.encode() + rgbe.tobytes())
    told: list[str] = []
    np.testing.assert_array_equal(read_environment(tmp_path / "map.hdr", told.append)[..., 1], upright)
    assert len(told) == 1 and "EXPOSURE" in told[0]


def test_environment_is_the_display_window_of_an_exr(tmp_path: Path) -> None:
    """What a compositor cut to what is not black, or rendered beyond the edges."""
    whole = np.zeros((8, 16, 3), np.float32)
    whole[3:5, 6:12] = np.arange(36, dtype=np.float32).reshape(2, 6, 3)
    for top, left, bottom, right in ((3, 6, 5, 12), (-1, -2, 9, 18)):
        spec = oiio.ImageSpec(right - left, bottom - top, 3, oiio.FLOAT)
        spec.x, spec.y, spec.full_width, spec.full_height = left, top, 16, 8
        part = np.pad(whole, ((2, 2), (2, 2), (0, 0)), constant_values=9.0)[
            top + 2 : bottom + 2, left + 2 : right + 2
        ]
        output = oiio.ImageOutput.create(str(tmp_path / "part.exr"))
        assert output.open(str(tmp_path / "part.exr"), spec) and output.write_image(part.copy())
        output.close()
        np.testing.assert_array_equal(read_environment(tmp_path / "part.exr"), whole)


def test_environment_file_round_trips(tmp_path: Path) -> None:
    radiance = np.random.default_rng(0).lognormal(0, 2, (16, 32, 3)).astype(np.float32)
    write_environment(tmp_path / "map.exr", radiance)
    np.testing.assert_array_equal(read_environment(tmp_path / "map.exr"), radiance)
    write_environment(tmp_path / "map.hdr", radiance)
    brightest = radiance.max(axis=2, keepdims=True)  # shares its exponent with the pixel's other two
    assert (np.abs(read_environment(tmp_path / "map.hdr") - radiance) <= 0.01 * brightest).all()
    with pytest.raises(ConfigError, match=r"written as \.hdr or \.exr"):
        write_environment(tmp_path / "map.png", radiance)
