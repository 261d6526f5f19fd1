"""Scenes and batches with little or nothing in them, and Gaussians that are no numbers."""

import numpy as np
import pytest

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from tests.support.trace_scenes import facing_z, make_cloud, make_tracer, random_gradients, rays_inwards


def assert_sees_nothing(cloud: FlatGaussians, rays: RayBatch) -> None:
    tracer = make_tracer(cloud)
    seen = tracer.trace(rays, record=True)
    count = len(rays)
    assert seen.hit_counts.tolist() == [0] * count
    assert (seen.transmittance == 1).all() and (seen.alpha == 0).all()
    for name in ("rgb_srgb", "depth_sum", "depth_median", "normal_world", "expected_depth"):
        assert not getattr(seen, name).any()
    assert seen.recording is not None
    gradients = tracer.backward(seen.recording, random_gradients(np.random.default_rng(0), count))
    assert len(gradients.ids) == 0
    assert gradients.sh.shape == (0, *cloud.sh.shape[1:])


def test_trace_without_gaussians_is_transparent(rng: np.random.Generator) -> None:
    assert_sees_nothing(make_cloud(rng, 0), rays_inwards(rng, 50))


def test_trace_without_rays_is_empty(rng: np.random.Generator) -> None:
    assert_sees_nothing(make_cloud(rng, 50), rays_inwards(rng, 0))
    assert_sees_nothing(make_cloud(rng, 0), rays_inwards(rng, 0))


def test_trace_of_invisible_gaussians_is_transparent(rng: np.random.Generator) -> None:
    assert_sees_nothing(make_cloud(rng, 50, logits=(-20.0, -10.0)), rays_inwards(rng, 50))


def test_trace_of_missed_gaussians_is_transparent(rng: np.random.Generator) -> None:
    rays = rays_inwards(rng, 50)
    outwards = RayBatch(rays.origins_world, -rays.directions_world)
    assert_sees_nothing(make_cloud(rng, 50, size=0.01), outwards)


def test_visible_ones_among_invisible(rng: np.random.Generator) -> None:
    one = facing_z([0.0, 0.0, 0.0], opacities=0.5)
    rays = RayBatch(np.array([[0.0, 0.0, -2.0]]), np.array([[0.0, 0.0, 1.0]]))
    alone = make_tracer(one).trace(rays)
    assert alone.hit_counts.tolist() == [1]
    hidden = make_cloud(rng, 40, logits=(-20.0, -10.0))
    among = make_tracer(concatenate([hidden, one, hidden])).trace(rays, record=True)
    assert among.recording is not None
    assert among.recording.ids_of_ray(0).tolist() == [40]
    assert among.transmittance[0] == alone.transmittance[0]


@pytest.mark.parametrize("field", ["means_world", "log_scales", "opacity_logits", "quats_wxyz"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_nan_gaussian_does_not_affect_others(rng: np.random.Generator, field: str, value: float) -> None:
    if field == "opacity_logits" and value == np.inf:
        pytest.skip("an infinite logit is an opacity of one")
    cloud = make_cloud(rng, 300)
    rays = rays_inwards(rng, 80)
    good = make_tracer(cloud).trace(rays)
    bad = cloud.select(np.arange(10))
    getattr(bad, field)[:] = value
    both = make_tracer(concatenate([cloud, bad])).trace(rays)
    np.testing.assert_array_equal(both.hit_counts, good.hit_counts)
    np.testing.assert_array_equal(both.rgb_srgb, good.rgb_srgb)
