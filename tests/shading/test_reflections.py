"""Reflected rays in pairs, from surface to surface: closed forms."""

import numpy as np
import pytest
from test_deferred import BARE, floor, wall

from octasplat.engine.core.color import srgb_to_linear
from octasplat.engine.core.rays import ImageRays, RayBatch
from octasplat.engine.gaussians.model import concatenate
from octasplat.engine.render.renderer import background_color, render_rays
from octasplat.engine.render.supersampling import pixel_means
from octasplat.engine.shading.deferred import DeferredShading
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.shading.protocol import TracedRays
from octasplat.engine.shading.reflection_rays import (
    RoughnessProbe,
    backward_normals,
    backward_roughness,
    direction_uniforms,
    mean_of_pairs,
    sample_facets,
)
from octasplat.engine.shading.reflection_tracing import IncidentLight
from octasplat.engine.shading.split_sum import SurfacePoints
from octasplat.engine.trace.cpu.tracer import CpuTracer


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def test_numbers_are_even_and_follows_from_the_direction_and_the_salt_alone() -> None:
    ways = unit(np.random.default_rng(0).normal(size=(20_000, 3)))
    found = direction_uniforms(ways, 3)
    np.testing.assert_array_equal(found[:, ::-1], direction_uniforms(ways[::-1].copy(), 3))
    assert np.abs(found - direction_uniforms(ways, 4)).max() > 0.5
    counts, _, _ = np.histogram2d(*found, bins=10, range=[[0, 1], [0, 1]])
    assert counts.min() > 130 and counts.max() < 270  # 200 each


def test_facet_spread_follows_roughness() -> None:
    count = 4000
    way = np.tile(unit(np.array([0.3, 0.1, -1.0])), (count, 1))
    way = unit(way + np.random.default_rng(1).normal(scale=1e-3, size=way.shape))
    normal = np.tile([0.0, 0.0, 1.0], (count, 1))
    for roughness, least in ((0.6, 0.001), (0.02, 0.03)):
        surface = SurfacePoints.unoccluded(np.full((count, 5), roughness), normal, way)
        facets = sample_facets(surface, direction_uniforms(way, 0), min_slope=least)
        one, other = facets.normals(normal, 1.0), facets.normals(normal, -1.0)
        np.testing.assert_allclose(one[:, :2], -other[:, :2], atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(one, axis=1), 1)
        # The median of GGX's slopes among the flattest nine tenths: u = 0.45.
        expected = max(roughness**2 * np.sqrt(0.45 / 0.55), least)
        assert np.median(facets.slope) == pytest.approx(expected, rel=0.05)


def test_reflection_pair_differences_estimate_normal_gradient() -> None:
    count = 40_000
    rng = np.random.default_rng(2)
    way = np.tile(unit(np.array([0.5, -0.2, -1.0])), (count, 1)) + rng.normal(scale=1e-6, size=(count, 3))
    normal = np.tile(unit(np.array([0.1, 0.2, 1.0])), (count, 1))
    surface = SurfacePoints.unoccluded(np.full((count, 5), 0.1), normal, way)
    facets = sample_facets(surface, direction_uniforms(way, 0), min_slope=1e-3)
    colors, hidden = rng.normal(size=(3, 3)), rng.normal(size=3)

    def seen(facing: np.ndarray) -> IncidentLight:
        """Light and visibility that grow evenly with the reflected direction."""
        mirrored = way - 2 * (way * facing).sum(axis=1, keepdims=True) * facing
        return IncidentLight(mirrored @ hidden, mirrored @ colors)

    one, other = (seen(facets.normals(normal, sign)) for sign in (1.0, -1.0))
    pairs = IncidentLight(*(np.concatenate(both) for both in zip(one, other, strict=True)))
    around, by_incoming = np.full((count, 3), 2.0), np.tile([1.0, -0.5, 0.25], (count, 1))
    found = backward_normals(pairs, facets, around, by_incoming).mean(axis=0)

    def loss(facing: np.ndarray) -> float:
        visibility, light = seen(facing)
        return float((by_incoming[:1] * (light[:1] + visibility[:1, None] * around[:1])).sum())

    steps = 1e-5 * np.eye(3)
    expected = np.array([(loss(normal + h) - loss(normal - h)) / 2e-5 for h in steps])
    expected -= (expected @ normal[0]) * normal[0]
    np.testing.assert_allclose(found, expected, atol=0.03 * np.linalg.norm(expected))
    np.testing.assert_allclose(mean_of_pairs(pairs).light_linear, seen(normal).light_linear, atol=5e-3)


def test_three_rays_say_how_the_mean_of_pairs_changes_with_the_roughness() -> None:
    count, roughness = 1000, 0.2
    rng = np.random.default_rng(4)
    way = np.tile(unit(np.array([0.5, -0.2, -1.0])), (count, 1)) + rng.normal(scale=1e-6, size=(count, 3))
    normal = np.tile(unit(np.array([0.1, 0.2, 1.0])), (count, 1))
    numbers = direction_uniforms(way, 0) * np.array([[0.2], [1.0]])  # none far out, where squares are not all
    curves, hidden = rng.normal(size=(3, 3)), rng.normal(size=3)

    def seen(facing: np.ndarray) -> IncidentLight:
        """Light and visibility that grow with the square of the reflected direction."""
        mirrored = way - 2 * (way * facing).sum(axis=1, keepdims=True) * facing
        return IncidentLight(mirrored**2 @ hidden, mirrored**2 @ curves)

    def mean(roughness: float) -> IncidentLight:
        surface = SurfacePoints.unoccluded(np.full((count, 5), roughness), normal, way)
        facets = sample_facets(surface, numbers, min_slope=1e-9)
        pair = (seen(facets.normals(normal, sign)) for sign in (1.0, -1.0))
        return mean_of_pairs(IncidentLight(*(np.concatenate(both) for both in zip(*pair, strict=True))))

    around, by_incoming = np.full((count, 3), 2.0), np.tile([1.0, -0.5, 0.25], (count, 1))
    change = IncidentLight(*(a - b for a, b in zip(mean(roughness), seen(normal), strict=True)))
    three = RoughnessProbe(np.arange(count), change)
    found = backward_roughness(three, np.full(count, roughness), around, by_incoming)

    def loss(roughness: float) -> np.ndarray:
        visibility, light = mean(roughness)
        return (by_incoming * (light + visibility[:, None] * around)).sum(axis=1)

    expected = (loss(roughness + 1e-3) - loss(roughness - 1e-3)) / 2e-3
    assert np.abs(expected).mean() > 1e-3
    np.testing.assert_allclose(found, expected, atol=0.02 * np.abs(expected).max())


def test_reflection_between_mirrors() -> None:
    half = [0.5, 0.5, 0.5, 1, 0.02]
    ground = wall((0, 0, 1), floor(1.5, 0.1), half)
    above = wall((0, 0, 1), floor(1.5, 0.1, above=0.5), half)
    lid = above.select(np.abs(above.means_world[:, 0] - 0.5) < 0.25)
    scene = concatenate([ground, lid])
    way = unit(np.array([[1.0, 0.03, -1.0]]))
    rays = RayBatch(np.array([[-0.1, 0.0, 0.1]]), way)
    radiance = np.full((16, 32, 3), 0.9, np.float32)
    radiance[8:] = 0.1  # the lower half
    shown = {}
    for surfaces in (1, 2, 3):
        settings = MaterialSettings(
            **BARE, max_bounces=surfaces, reflection_ray_slope=(1e-3, 1e-3), ray_bias=0.01
        )
        model = DeferredShading(settings, extent_world=1.0)
        model.light.set_radiance(radiance)
        tracer = CpuTracer(threads=1)
        tracer.build(scene, model.features(scene))
        found = model.shade(TracedRays(rays, tracer.trace(rays), tracer)).rgb_srgb[0]
        shown[surfaces] = float(srgb_to_linear(found).mean())
    # Ground, lid, ground, and out into the upper half; cut off at the lid, that mirrors the lower half.
    assert shown[1] == pytest.approx(0.1 * 0.5**2, abs=0.01)
    assert shown[2] == pytest.approx(0.9 * 0.5**3, abs=0.01)
    assert shown[3] == pytest.approx(shown[2], abs=1e-3)


def half_a_row() -> tuple[CpuTracer, ImageRays, DeferredShading]:
    """Nine pixels before a plate that ends in the fifth."""
    plate = wall((0, 0, 1), floor(2.0, 0.05), [0.8, 0.8, 0.8, 0.0, 1.0])
    plate = plate.select(plate.means_world[:, 0] < -0.12)
    model = DeferredShading(MaterialSettings(**BARE), extent_world=1.0)
    model.light.set_radiance(np.full((16, 32, 3), 0.5, np.float32))
    tracer = CpuTracer(threads=1)
    tracer.build(plate, model.features(plate))
    x = np.linspace(-1.6, 1.6, 9)
    ways = np.stack([x, np.zeros(9), np.full(9, -4.0)], axis=1)[None]
    return tracer, ImageRays.from_directions(np.array([0, 0, 4.0]), unit(ways)), model


def test_outline_pixel_coverage() -> None:
    found = pixel_means(*half_a_row(), 2)
    # 64 rays across give 0.650.
    np.testing.assert_allclose(found.alpha[0], [1, 1, 1, 1, 0.65, 0, 0, 0, 0], atol=0.005)
    np.testing.assert_allclose(found.linear[0, :5], 0.5 * (0.8 + 0.04), atol=0.03)


def test_pixels_with_varying_rays_get_more_samples() -> None:
    tracer, image, model = half_a_row()
    found, many = pixel_means(tracer, image, model, 2), pixel_means(tracer, image, model, 4)
    quarters = [(a, b) for a in (-0.25, 0.25) for b in (-0.25, 0.25)]
    black = background_color("black")
    few = np.mean([render_rays(tracer, image.shifted(*at), black, model).alpha for at in quarters], axis=0)
    assert abs(few[0, 4] - many.alpha[0, 4]) > 0.01  # two columns see the edge elsewhere than four
    assert found.alpha[0, 4] == pytest.approx(many.alpha[0, 4], abs=1e-6)
    even = np.arange(9) != 4
    np.testing.assert_allclose(found.alpha[0, even], few[0, even], atol=1e-6)
