"""The fit of residual colors: what it finds, that all else is kept, and that threads change nothing."""

import numpy as np
import pytest

from octasplat.engine.core.errors import CancelledError
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.runs.config import resolve_config
from octasplat.engine.shading.exposure import ExposureModel
from octasplat.engine.shading.plain import PLAIN_SHADING, PlainShading
from octasplat.engine.shading.protocol import ShadedRays, ShadingModel, TracedRays
from octasplat.engine.shading.residual_colors import residual_of, with_residual
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.train.config import TrainConfig, residual_iteration_count
from octasplat.engine.train.loop.residual_fit import fit_residual_colors
from tests.support.planar_dataset import PlanarDataset

WANTING_SRGB = np.array([0.1, -0.05, 0.02], np.float32)
"""What the shading takes off all colors."""
NONE_EXCLUDED = np.empty(0, np.int64)


class _Darkened(PlainShading):
    """Shows less than the photographs do."""

    def shade(self, traced: TracedRays) -> ShadedRays:
        result = traced.result
        return ShadedRays(result.rgb_srgb - result.alpha[:, None] * WANTING_SRGB, result.transmittance)


def settings() -> TrainConfig:
    config = resolve_config("fast", materials=True, assignments=["rays_per_batch=1024"]).train
    return config.model_copy(update={"sh_degree": 1})


def fitted(
    world: PlanarDataset,
    scene: FlatGaussians,
    shading: ShadingModel,
    *,
    iterations: int = 160,
    threads: int = 1,
) -> np.ndarray:
    return fit_residual_colors(
        scene,
        world,
        shading,
        settings(),
        iterations=iterations,
        excluded_views=NONE_EXCLUDED,
        threads=threads,
    )


def shown_residual(world: PlanarDataset, scene: FlatGaussians, residual_sh: np.ndarray) -> np.ndarray:
    """Return the median residual color over the pixels of a view that are covered."""
    tracer = make_tracer()
    tracer.build(with_residual(scene, residual_sh))
    y, x = np.divmod(np.arange(40 * 40), 40)
    result = tracer.trace(world.rays(np.zeros_like(y), y, x))
    covered = result.alpha > 0.9
    assert covered.mean() > 0.5
    return np.median(residual_of(result)[covered], axis=0)


def test_finds_what_the_shading_lacks_and_keeps_the_scene() -> None:
    world = PlanarDataset()
    scene = world.initial_gaussians(count=400, painted=True, opacity=0.99)
    before = scene.copy()
    # the paint is no exact picture: what the shading takes off is the difference of both fits
    with_all, lacking = (fitted(world, scene, shading) for shading in (PLAIN_SHADING, _Darkened()))
    found = shown_residual(world, scene, lacking) - shown_residual(world, scene, with_all)
    np.testing.assert_allclose(found, WANTING_SRGB, atol=0.01)
    for name in ("means_world", "quats_wxyz", "log_scales", "opacity_logits", "sh"):
        np.testing.assert_array_equal(getattr(scene, name), getattr(before, name))


def test_threads_change_nothing() -> None:
    world = PlanarDataset()
    scene = world.initial_gaussians(count=200, painted=True, opacity=0.9)
    one, two = (fitted(world, scene, _Darkened(), iterations=24, threads=count) for count in (1, 2))
    np.testing.assert_array_equal(one, two)


def test_exposures_are_taken_into_account() -> None:
    world = PlanarDataset()
    scene = world.initial_gaussians(count=400, painted=True, opacity=0.99)
    exposures = ExposureModel(len(world.views), rate=0.0, inner=_Darkened())
    exposures.offsets[:] = WANTING_SRGB  # photographs are exposed to just what is wanting
    exposed, plain = (fitted(world, scene, shading) for shading in (exposures, PLAIN_SHADING))
    found = shown_residual(world, scene, exposed) - shown_residual(world, scene, plain)
    np.testing.assert_allclose(found, 0, atol=0.01)


def test_can_be_stopped() -> None:
    world = PlanarDataset()
    scene = world.initial_gaussians(count=50, painted=True, opacity=0.9)
    asked: list[int] = []

    def should_stop() -> bool:
        asked.append(1)
        return len(asked) > 3

    with pytest.raises(CancelledError, match="fitting residual colors"):
        fit_residual_colors(
            scene,
            world,
            PLAIN_SHADING,
            settings(),
            iterations=50,
            excluded_views=NONE_EXCLUDED,
            threads=1,
            should_stop=should_stop,
        )
    assert len(asked) == 4


@pytest.mark.parametrize(
    ("materials", "assigned", "expected"), [(True, "0.5", 50), (True, "0", 0), (False, "0.5", 0)]
)
def test_iterations_follow_those_of_the_training(materials: bool, assigned: str, expected: int) -> None:
    given = [f"materials.residual_share={assigned}"]
    config = resolve_config("fast", materials=materials, assignments=given).train
    assert residual_iteration_count(config, 100) == expected


def test_recipes_of_other_papers_have_none() -> None:
    for recipe in ("ref_gaussian", "near_field"):
        config = resolve_config("fast", materials=True, assignments=[f"materials.recipe={recipe}"]).train
        assert residual_iteration_count(config, 100) == 0
    assert residual_iteration_count(resolve_config("fast", materials=True).train, 100) > 0
