"""Rays that show two surfaces: each is shaded by itself, and gradients go to both."""

import numpy as np
import pytest
from test_deferred import BARE, floor, wall

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.shading.deferred import DeferredShading
from octasplat.engine.shading.depth_split import split_by_depth
from octasplat.engine.shading.material_settings import MaterialSettings
from octasplat.engine.shading.protocol import ShadedRayGradients, TracedRays
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import TraceSettings

DOWN = np.array([[0.0, 0.05, -1.0]]) / np.hypot(1, 0.05)
RAYS = RayBatch(np.array([[x, 0.0, 1.0] for x in (-0.3, 0.0, 0.3)]), np.repeat(DOWN, 3, axis=0))


def veil() -> FlatGaussians:
    """A leaning, half transparent sheet of green gloss above the floor."""
    sheet = wall((0.6, 0, 0.8), floor(1.0, 0.1, above=0.5), [0.1, 0.8, 0.2, 0.2, 0.3])
    sheet.opacity_logits[:] = -2.5
    return sheet


def ground() -> FlatGaussians:
    return wall((0, 0, 1), floor(1.0, 0.1), [0.9, 0.3, 0.1, 0.9, 0.2])


def model_of(**settings: float | bool) -> DeferredShading:
    model = DeferredShading(
        MaterialSettings(**(BARE | {"ambient_occlusion": False} | settings)), extent_world=1.0
    )
    rng = np.random.default_rng(3)
    model.light.log_radiance[:] = rng.normal(-1, 0.4, model.light.log_radiance.shape)
    return model


def traced(scene: FlatGaussians, model: DeferredShading) -> tuple[CpuTracer, TracedRays]:
    tracer = CpuTracer(TraceSettings(q=30.0, transmittance_min=1e-6), threads=1)
    tracer.build(scene, model.features(scene))
    return tracer, TracedRays(RAYS, tracer.trace(RAYS, record=True), tracer, np.zeros(3, np.int64))


def test_depth_split_colors_by_coverage() -> None:
    model = model_of(visibility=False)
    alone = [model.shade(traced(scene, model)[1]) for scene in (veil(), ground())]
    through = alone[0].transmittance[:, None]
    assert through.min() > 0.2 and through.max() < 0.8
    expected = alone[0].rgb_srgb + through * alone[1].rgb_srgb
    both = traced(concatenate([ground(), veil()]), model)[1]
    np.testing.assert_allclose(model.shade(both).rgb_srgb, expected, atol=2e-3)
    # Shaded as one surface, the two would be a third.
    merged = model_of(visibility=False, depth_split=0.0)
    assert np.abs(merged.shade(both).rgb_srgb - expected).max() > 0.02


def test_depth_split_layers_sum_to_ray() -> None:
    model = model_of()
    tracer, sight = traced(concatenate([ground(), veil()]), model)
    found = split_by_depth(
        sight.rays, sight.result, tracer, min_separation_world=0.01, record_for_backward=False
    )
    np.testing.assert_array_equal(found.split_ids, [0, 1, 2])
    assert len(found.rays) == len(found.results.depth_sum) == 6
    for name in ("features", "normal_world", "rgb_srgb"):
        np.testing.assert_allclose(
            found.sum_layers(getattr(found.results, name)), getattr(sight.result, name), atol=1e-6
        )
    np.testing.assert_allclose(
        found.sum_layers(found.results.alpha[:, None])[:, 0], sight.result.alpha, atol=1e-6
    )
    depths = found.results.depth_sum / found.results.alpha
    np.testing.assert_allclose(depths[:3], 1 / -DOWN[0, 2], atol=0.01)  # the floor
    np.testing.assert_allclose(depths[3:], 0.5 / -DOWN[0, 2], atol=0.25)  # the sheet, which leans
    tracer, sight = traced(ground(), model)
    assert (
        len(
            split_by_depth(
                sight.rays, sight.result, tracer, min_separation_world=0.01, record_for_backward=False
            ).split_ids
        )
        == 0
    )


@pytest.mark.parametrize("visibility", [False, True])
def test_gradients_of_both_surfaces_agree_with_finite_differences(visibility: bool) -> None:
    model = model_of(visibility=visibility, indirect="none", blur=0.0, normal_gradient_clip=0.0)
    scene = concatenate([ground(), veil()])
    by_rgb = np.random.default_rng(4).normal(size=(3, 3)).astype(np.float32)

    def loss() -> float:
        sight = traced(scene, model)[1]
        return float((by_rgb * model.shade(sight).rgb_srgb).astype(np.float64).sum())

    tracer, sight = traced(scene, model)
    back = model.backward(sight, model.shade(sight), ShadedRayGradients(by_rgb, np.zeros(3, np.float32)))
    assert sight.result.recording is not None and len(back.recorded_traces) == 1
    columns = {"albedo": slice(0, 3), "metallic": slice(3, 4), "roughness": slice(4, 5)}
    whole = {name: np.zeros_like(scene.channels[name]) for name in columns}
    whole |= {"opacity_logits": np.zeros_like(scene.opacity_logits)}
    for hits, by in ((sight.result.recording, back.trace), *back.recorded_traces):
        found = tracer.backward(hits, by).numpy()
        whole["opacity_logits"][found.ids] += found.opacity_logits
        for name, column in columns.items():
            whole[name][found.ids] += found.features[:, column]
    for name, gradient in whole.items():
        if visibility and name == "opacity_logits":
            continue  # no gradient goes through what hides reflections
        parameter = scene.opacity_logits if name == "opacity_logits" else scene.channels[name]
        before, direction = parameter.copy(), gradient / np.linalg.norm(gradient)
        for half in (slice(0, 400), slice(400, None)):  # of the floor, of the sheet
            step = np.zeros_like(parameter)
            step[half] = np.float32(0.02) * direction[half]
            values = []
            for sign in (1, -1):
                parameter[:] = before + sign * step
                values.append(loss())
            parameter[:] = before
            expected = float((gradient * step).sum())
            assert values[0] - values[1] == pytest.approx(2 * expected, rel=0.03, abs=2e-5), name
