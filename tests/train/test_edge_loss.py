"""The term of the loss for edges: which rays count, and its gradient by finite differences."""

from dataclasses import replace

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.runs.config import resolve_config
from octasplat.engine.shading.exposure import ExposureModel
from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import TraceResult
from octasplat.engine.train.config import LossWeights
from octasplat.engine.train.optimization.edge_loss import edge_gradient, passes_edge
from octasplat.engine.train.sampling.batches import Batch, BatchOptions, BatchSource
from tests.support.planar_dataset import PlanarDataset


def traced(transmittance: float, depth: float, depth_median: float) -> TraceResult:
    one, none = np.ones(1, np.float32), np.zeros((1, 3), np.float32)
    alpha = 1 - transmittance
    return TraceResult(
        none,
        transmittance * one,
        depth * alpha * one,
        depth_median * one,
        none,
        none[:, :0],
        one.astype("i4"),
    )


@pytest.mark.parametrize(
    ("transmittance", "depth", "depth_median", "expected"),
    [
        (1.0, 0.0, 0.0, False),  # past everything
        (0.0, 2.0, 2.0, False),  # one surface
        (0.0, 2.03, 2.0, True),  # one before another
        (0.5, 2.0, 2.0, True),  # one before nothing
        (0.99, 2.0, 0.0, True),  # haze before nothing
    ],
)
def test_rays_that_pass_an_edge(
    transmittance: float, depth: float, depth_median: float, expected: bool
) -> None:
    assert passes_edge(traced(transmittance, depth, depth_median)).tolist() == [expected]


@pytest.mark.parametrize("exposed", [False, True])
def test_gradient_of_the_edge_term_is_its_slope(exposed: bool) -> None:
    world = PlanarDataset()
    start = world.initial_gaussians(count=60, painted=True, opacity=0.99)
    start.means_world[start.means_world[:, 0] > 0, 2] -= 0.4  # one half before the other
    rng = np.random.default_rng(0)
    view, y, x = rng.integers(1, 7, 300), rng.integers(0, 40, 300), rng.integers(0, 40, 300)
    rays, (target, alpha, weight) = world.rays(view, y, x), world.pixels(view, y, x)
    background = np.array([0.2, 0.4, 0.6], np.float32)
    batch = Batch(rays, target, alpha, weight, view, 0, 8, background)
    weights = LossWeights(l1=0.0, l2=1.0, edges=0.7)
    exposures = ExposureModel(9, rate=0.01)
    if exposed:
        exposures.log_gains[:], exposures.offsets[:] = rng.normal(0, 0.2, (2, 9, 3))
    gains, offsets = np.exp(exposures.log_gains)[view], exposures.offsets[view]
    tracer = make_tracer()
    tracer.build(start)
    chosen = passes_edge(tracer.trace(rays))
    assert 30 < chosen.sum() < 300

    def loss(opacity_logits: np.ndarray) -> float:
        moved = make_tracer()
        moved.build(replace(start, opacity_logits=opacity_logits.astype(np.float32)))
        result = moved.trace(rays)
        shown = gains * result.rgb_srgb + offsets * result.alpha[:, None]
        render = shown + result.transmittance[:, None] * background
        squared = (render.astype(np.float64) - batch.target_srgb) ** 2
        return 0.7 * float((squared.mean(axis=1) * chosen).sum() / 300)

    shading = exposures if exposed else PLAIN_SHADING
    found = tracer.backward(*edge_gradient(batch, tracer, shading, weights, training_progress=0.5)).numpy()
    logits = start.opacity_logits.astype(np.float64)
    for row in np.argsort(-np.abs(found.opacity_logits))[:5]:
        step = np.zeros(60)
        step[found.ids[row]] = 1e-2
        slope = (loss(logits + step) - loss(logits - step)) / 2e-2
        assert found.opacity_logits[row] == pytest.approx(slope, rel=0.02)


def test_further_rays_are_drawn_where_the_loss_has_the_term() -> None:
    options = BatchOptions(256, "black", 64, 16, None, 16, 0.0)
    world = PlanarDataset()
    plain = BatchSource(world, options).draw(np.random.default_rng(0), 3)
    both = BatchSource(world, replace(options, has_edge_rays=True)).draw(np.random.default_rng(0), 3)
    assert plain.edge_batch is None and both.edge_batch is not None
    assert (plain.rays.directions_world == both.rays.directions_world).all()
    assert len(both.edge_batch.rays) == 256
    assert (both.edge_batch.rays.directions_world != both.rays.directions_world).any()


@pytest.mark.parametrize(
    ("recipe", "expected"), [("split_sum", True), ("ref_gaussian", False), ("near_field", False)]
)
def test_rays_for_edges_ask_for_harmonics_that_learn_the_shaded_colors(recipe: str, expected: bool) -> None:
    config = resolve_config("fast", materials=True, assignments=[f"materials.recipe={recipe}"]).train
    assert BatchOptions.from_config(config, PlanarDataset()).has_edge_rays == expected


def test_edges_without_materials_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"loss\.edges is for trainings with materials: set it to 0"):
        resolve_config("fast", settings={}, assignments=["loss.edges=1"])
