"""However far Gaussians move between two builds, none is clipped: refreshing is as good as rebuilding."""

from collections.abc import Iterator

import numpy as np
import pytest

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.cpu.tracer import CpuTracer
from tests.support.trace_scenes import (
    assert_matches_reference,
    f32,
    hit_lists,
    make_cloud,
    rays_inwards,
    same_bits,
    unit,
)

STEPS, MOVE, GROWTH = 25, 0.14, 0.04
"""What training does at most between two builds: moves of so much of a Gaussian's size, growth by so much."""


@pytest.fixture(params=["always", "never"])
def way(request: pytest.FixtureRequest) -> str:
    """Packets and single rays."""
    return str(request.param)


def tiles(rng: np.random.Generator) -> RayBatch:
    """Bundles of 16 rays, each from one point, and loose ones."""
    loose = rays_inwards(rng, 200)
    origins = np.repeat(loose.origins_world[:25], 16, axis=0)
    directions = np.repeat(loose.directions_world[:25], 16, axis=0) + 0.04 * rng.normal(size=(400, 3))
    return RayBatch(
        np.concatenate([origins, loose.origins_world]),
        np.concatenate([unit(directions), loose.directions_world]),
    )


def steps(cloud: FlatGaussians, rng: np.random.Generator) -> Iterator[np.ndarray]:
    """What each step changes; every Gaussian goes on in one direction, and half of them grow."""
    count = len(cloud)
    heading = f32(unit(rng.normal(size=(count, 3))))
    growth = f32(np.log1p(GROWTH) * (rng.random((count, 1)) < 0.5))
    for _ in range(STEPS):
        ids = np.flatnonzero(rng.random(count) < 0.7).astype(np.int32)
        size = np.exp(cloud.log_scales[ids]).max(axis=1, keepdims=True)
        cloud.means_world[ids] += MOVE * size * heading[ids]
        cloud.log_scales[ids] += growth[ids]
        yield ids


def test_refit_boxes_cover_training_steps(rng: np.random.Generator, way: str) -> None:
    cloud = make_cloud(rng, 1500, size=0.05)
    rays = tiles(rng)
    refreshed, fresh = CpuTracer(packet_mode=way, box_padding=0.1), CpuTracer(packet_mode=way)
    refreshed.build(cloud)
    before = refreshed.trace(rays)
    for number, ids in enumerate(steps(cloud, rng)):
        refreshed.refresh(ids)
        if number % 8 == 0 or number == STEPS - 1:
            fresh.build(cloud)
            one, other = refreshed.trace(rays, record=True), fresh.trace(rays, record=True)
            assert hit_lists(one) == hit_lists(other)
            same_bits(one, other)
    assert np.abs(before.rgb_srgb - one.rgb_srgb).mean() > 0.05
    assert_matches_reference(cloud, rays[::10])


def test_refit_shows_gaussians_invisible_at_build(rng: np.random.Generator, way: str) -> None:
    cloud = make_cloud(rng, 300, size=0.1, logits=(-12.0, -8.0))
    rays = tiles(rng)
    tracer, fresh = CpuTracer(packet_mode=way), CpuTracer(packet_mode=way)
    tracer.build(cloud)
    assert not tracer.trace(rays).hit_counts.any()
    cloud.opacity_logits[:150] = 1.0
    tracer.refresh(np.arange(150, dtype=np.int32))
    fresh.build(cloud)
    seen = tracer.trace(rays)
    assert seen.hit_counts.any()
    same_bits(seen, fresh.trace(rays))


def test_refit_removes_boxes_of_vanished_gaussians(rng: np.random.Generator, way: str) -> None:
    cloud = make_cloud(rng, 300, size=0.1)
    rays = tiles(rng)
    tracer = CpuTracer(packet_mode=way)
    tracer.build(cloud)
    cloud.opacity_logits[:] = -20.0
    tracer.refresh()
    assert (tracer.trace(rays).transmittance == 1).all()
    cloud.opacity_logits[:] = 1.0
    cloud.means_world += f32(5.0)
    tracer.refresh()
    fresh = CpuTracer(packet_mode=way)
    fresh.build(cloud)
    shifted = RayBatch(rays.origins_world + f32(5.0), rays.directions_world)
    assert tracer.trace(shifted).hit_counts.any()
    for batch in (rays, shifted):
        same_bits(tracer.trace(batch), fresh.trace(batch))
