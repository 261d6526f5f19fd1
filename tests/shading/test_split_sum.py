"""Split-sum shading against closed forms, brute force, its slow twin and finite differences."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.shading.environment_frame import environment_frame
from octasplat.engine.shading.environment_levels import (
    ROUGHNESSES,
    EnvironmentLevels,
    EnvironmentPrefilter,
    prefilter_for,
    resample_environment,
)
from octasplat.engine.shading.split_sum import SurfacePoints, shade, shade_backward, split_sum_table
from tests.support.split_sum_reference import reference_split_sum

HEIGHT = 16
FRAME = environment_frame(np.array([0.2, 0.3, 0.9]), 25.0)


def directions(height: int) -> np.ndarray:
    polar = (np.arange(height) + 0.5) / height * np.pi
    longitude = ((np.arange(2 * height) + 0.5) / height - 1) * np.pi
    ring = np.sin(polar)[:, None]
    up = np.broadcast_to(np.cos(polar)[:, None], (height, 2 * height))
    return np.stack([ring * np.sin(longitude), up, ring * np.cos(longitude)], axis=-1).reshape(-1, 3)


def surface(rng: np.random.Generator, count: int) -> SurfacePoints:
    normal, way = (x / np.linalg.norm(x, axis=1)[:, None] for x in rng.normal(size=(2, count, 3)))
    normal *= -np.sign((normal * way).sum(axis=1))[:, None]
    steep = -(normal * way).sum(axis=1) < 0.1
    normal[steep] = -way[steep]
    return SurfacePoints(
        rng.uniform(0.06, 0.95, (count, 5)), normal, way, rng.uniform(0, 1, count),
        rng.uniform(0, 1, (count, 3)), rng.uniform(0, 1, count), rng.uniform(0, 1, (count, 3)),
    )  # fmt: skip


def light(rng: np.random.Generator) -> EnvironmentLevels:
    return prefilter_for(HEIGHT).levels(rng.lognormal(0, 0.7, (HEIGHT, 2 * HEIGHT, 3)))


def test_split_sum_table_limits() -> None:
    table = split_sum_table()
    cosines = np.linspace(0, 1, table.shape[1])[1:]
    # A mirror loses nothing, and Schlick's term is its bias.
    np.testing.assert_allclose(table[0, 1:].sum(axis=1), 1, atol=2e-3)
    np.testing.assert_allclose(table[0, 1:, 1], (1 - cosines) ** 5, atol=2e-3)
    # Rough facets hide each other: by brute force over the hemisphere, head-on, GGX alpha 1 (D = 1/pi).
    cos_i = (np.arange(4000) + 0.5) / 4000
    half = np.sqrt((1 + cos_i) / 2)
    masking = 2 / (1 + np.sqrt(1 + (1 - cos_i**2) / cos_i**2))
    value = masking / np.pi / (4 * 1.0) * 2 * np.pi / 4000
    fresnel = (1 - half) ** 5
    np.testing.assert_allclose(
        table[-1, -1], [(value * (1 - fresnel)).sum(), (value * fresnel).sum()], rtol=0.01
    )


def test_levels_of_even_light_are_even_and_those_of_any_are_lobes() -> None:
    even = prefilter_for(HEIGHT).levels(np.full((HEIGHT, 2 * HEIGHT, 3), 2.0))
    np.testing.assert_allclose(even.texels, 2.0, rtol=1e-5)
    radiance = np.random.default_rng(0).lognormal(0, 1, (32, 64, 3))
    levels = EnvironmentPrefilter(32).levels(radiance)
    ways = directions(32)
    ring = np.sqrt(1 - ways[:, 1] ** 2)
    for level in (3, 5, 6):  # roughness 0.5 and 1, and the irradiance
        height = int(levels.heights[level])
        cosine = directions(height) @ ways.T
        weights = np.maximum(cosine, 0) * ring
        if level < 6:
            a2 = ROUGHNESSES[level] ** 4
            weights /= ((1 + np.maximum(cosine, 0)) / 2 * (a2 - 1) + 1) ** 2
        expected = weights @ radiance.reshape(-1, 3) / weights.sum(axis=1, keepdims=True)
        found = levels.texels[levels.offsets[level] :][: 2 * height * height]
        assert np.abs(found / expected - 1).mean() < 0.08  # from a halved map


def test_prefilter_backward_is_transpose() -> None:
    rng = np.random.default_rng(1)
    radiance = rng.uniform(0, 1, (HEIGHT, 2 * HEIGHT, 3))
    levels = prefilter_for(HEIGHT).levels(radiance)
    gradient = rng.normal(size=levels.texels.shape)
    there = (levels.texels * gradient).sum()
    assert (prefilter_for(HEIGHT).backward(gradient) * radiance).sum() == pytest.approx(there, rel=1e-4)


def test_split_sum_matches_reference() -> None:
    rng = np.random.default_rng(2)
    levels, points = light(rng), surface(rng, 400)
    leaves = [torch.from_numpy(getattr(points, field.name)).clone() for field in fields(points)]
    leaves.append(torch.from_numpy(levels.texels).double())
    for leaf in leaves:
        leaf.requires_grad_()
    expected = reference_split_sum(*leaves, levels, FRAME)
    np.testing.assert_allclose(shade(points, levels, FRAME), expected.detach(), rtol=1e-6, atol=1e-9)
    by_rgb = rng.normal(size=expected.shape)
    expected.backward(torch.from_numpy(by_rgb))
    found = shade_backward(points, levels, FRAME, by_rgb)
    gradients = [leaf.grad.numpy() for leaf in leaves if leaf.grad is not None]
    material, normal, _direction, visibility, indirect, ambient, bounced, texels = gradients
    np.testing.assert_allclose(found.normal + found.reflected, normal, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(found.sum_texels(len(texels)), texels, rtol=1e-6, atol=1e-9)
    for name, value in {
        "material": material, "visibility": visibility, "indirect": indirect, "ambient": ambient,
        "bounced": bounced,
    }.items():  # fmt: skip
        np.testing.assert_allclose(getattr(found, name), value, rtol=1e-6, atol=1e-9, err_msg=name)


def test_gradients_agree_with_finite_differences() -> None:
    rng = np.random.default_rng(3)
    levels, points = light(rng), surface(rng, 50)
    by_rgb = rng.normal(size=(50, 3))
    found = shade_backward(points, levels, FRAME, by_rgb)
    gradients = {
        "material": found.material,
        "normal_world": found.normal + found.reflected,
        "visibility": found.visibility,
        "indirect_linear": found.indirect,
        "ambient": found.ambient,
        "bounced_linear": found.bounced,
    }
    for name, gradient in gradients.items():
        value = getattr(points, name)
        step = 1e-8 * rng.normal(size=value.shape)
        above, below = (
            (shade(replace(points, **{name: value + sign * step}), levels, FRAME) * by_rgb).sum()
            for sign in (1, -1)
        )
        assert (above - below) / 2 == pytest.approx((gradient * step).sum(), rel=1e-3), name


def test_split_sum_blur_changes_reflected_direction_only() -> None:
    rng = np.random.default_rng(4)
    levels, points = light(rng), surface(rng, 20)
    sharp = shade_backward(points, levels, FRAME, np.ones((20, 3)))
    led = shade_backward(points, levels, FRAME, np.ones((20, 3)), blur=0.6)
    rough = points.material[:, 4] >= 0.6
    np.testing.assert_array_equal(sharp.reflected[rough], led.reflected[rough])
    assert (sharp.reflected[~rough] != led.reflected[~rough]).any(axis=1).all()
    np.testing.assert_array_equal(sharp.material, led.material)


def test_resampling_keeps_the_light() -> None:
    radiance = np.random.default_rng(5).uniform(0, 1, (64, 128, 3))
    small = resample_environment(radiance, 16)
    for map_ in (radiance, small):
        edges = np.cos(np.arange(len(map_) + 1) / len(map_) * np.pi)
        mean = ((edges[:-1] - edges[1:])[:, None] / 2 * map_.mean(axis=1)).sum(axis=0)
        np.testing.assert_allclose(mean, [0.5] * 3, atol=0.01)
    with pytest.raises(ConfigError, match="multiple of 8"):
        EnvironmentPrefilter(20)
