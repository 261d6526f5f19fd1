"""Residual colors: added to what materials show, in every layer that holds it, and nowhere else."""

from dataclasses import replace

import numpy as np
import pytest

from octasplat.engine.core.color import linear_to_srgb, srgb_to_linear
from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.shading.exposure import ExposureModel
from octasplat.engine.shading.plain import PlainShading
from octasplat.engine.shading.protocol import LINEAR, ShadedRays, TracedRays
from octasplat.engine.shading.residual_colors import ResidualColors, with_residual_layers
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.train.shading_factory import add_residual, find_residual

RADIANCE = np.array([0.2, 0.5, 3.0], np.float32)
WANTED_SRGB = np.array([0.1, -0.2, 0.05], np.float32)


class _OneRadiance(PlainShading):
    """Shows one radiance on all that is met, as a model of materials does."""

    def shade(self, traced: TracedRays) -> ShadedRays:
        result = traced.result
        shown = linear_to_srgb(np.minimum(RADIANCE, np.float32(1)))
        layers = {LINEAR: np.broadcast_to(RADIANCE, (len(traced.rays), 3))}
        return ShadedRays(result.alpha[:, None] * shown, result.transmittance, None, layers)


def plane_before_the_camera() -> FlatGaussians:
    """One Gaussian of 4 units that faces rays along z, 2 units away."""
    half = np.sqrt(0.5)
    return FlatGaussians(
        np.array([[0, 0, 2]], np.float32),
        np.array([[half, 0, half, 0]], np.float32),  # its normal along z
        np.log(np.full((1, 2), 4, np.float32)),
        np.full(1, 3, np.float32),
        np.zeros((1, 4, 3), np.float32),
    )


def shaded_with(residual_srgb: np.ndarray) -> tuple[TracedRays, ShadedRays, ShadedRays]:
    """Return what was traced, and the colors without and with a residual of one color."""
    origins = np.zeros((5, 3), np.float32)
    origins[:, 0] = np.linspace(-0.2, 0.2, 5)
    rays = RayBatch(origins, np.tile(np.float32([0, 0, 1]), (5, 1)))
    scene, inner = plane_before_the_camera(), _OneRadiance()
    residual_sh = scene.sh.copy()
    residual_sh[:, 0] = residual_srgb / np.float32(SH_C0)
    tracer, around = make_tracer(), make_tracer()
    tracer.build(scene)
    traced = TracedRays(rays, tracer.trace(rays), tracer)
    return traced, inner.shade(traced), ResidualColors(inner, scene, residual_sh, around).shade(traced)


def test_residual_is_added_to_picture_and_radiance() -> None:
    traced, before, after = shaded_with(WANTED_SRGB)
    assert traced.result.alpha.min() > 0.9
    added = traced.result.alpha[:, None] * WANTED_SRGB
    np.testing.assert_allclose(after.rgb_srgb, before.rgb_srgb + added, atol=1e-6)
    np.testing.assert_array_equal(after.transmittance, before.transmittance)
    shown = linear_to_srgb(RADIANCE[:2]) + WANTED_SRGB[:2]
    np.testing.assert_allclose(after.layers[LINEAR][:, :2], np.tile(srgb_to_linear(shown), (5, 1)), rtol=1e-5)
    # brighter than white: white and a little more is white
    np.testing.assert_allclose(after.layers[LINEAR][:, 2], 3.0, rtol=1e-6)


def test_no_residual_changes_nothing() -> None:
    _, before, after = shaded_with(np.zeros(3, np.float32))
    np.testing.assert_allclose(after.rgb_srgb, before.rgb_srgb, atol=1e-7)
    np.testing.assert_allclose(after.layers[LINEAR], before.layers[LINEAR], rtol=1e-6)


def test_residual_lies_below_the_exposures() -> None:
    traced, *_ = shaded_with(WANTED_SRGB)
    scene = plane_before_the_camera()
    exposures = ExposureModel(1, rate=0.0, inner=_OneRadiance())
    exposures.log_gains[:] = np.log(0.5)
    residual = ResidualColors(exposures.inner, scene, scene.sh + np.float32(0.3), make_tracer())
    model = add_residual(exposures, residual)
    assert find_residual(model) is not None and find_residual(exposures) is None
    seen = replace(traced, view=np.zeros(len(traced.rays), np.int64))
    np.testing.assert_allclose(model.shade(seen).rgb_srgb, 0.5 * model.shade(traced).rgb_srgb, rtol=1e-5)


@pytest.mark.parametrize("radiance", [1.0, 1.3, 3.0])
@pytest.mark.parametrize("wanting", [-0.3, -0.5])
def test_residual_darkens_what_is_brighter_than_white_as_it_was_fitted(
    radiance: float, wanting: float
) -> None:
    """The fit sees white there, as a photograph does, and what it takes off."""
    layers = {LINEAR: np.full((1, 3), radiance, np.float32)}
    after = with_residual_layers(layers, np.full((1, 3), wanting, np.float32))[LINEAR]
    np.testing.assert_allclose(linear_to_srgb(np.minimum(after, 1)), 1 + wanting, atol=1e-5)


def test_radiance_above_white_has_no_steps() -> None:
    wanting = np.linspace(-0.35, 0.05, 601, dtype=np.float32)[:, None].repeat(3, axis=1)
    found = with_residual_layers({LINEAR: np.full((601, 3), 3, np.float32)}, wanting)[LINEAR]
    assert np.abs(np.diff(found, axis=0)).max() < 0.02 and found[-1, 0] == 3
    # what is as small as noise leaves lamps bright
    assert found[np.argmin(np.abs(wanting[:, 0] + 0.03)), 0] > 2.7
