"""Packets whose rays see their Gaussians in one order: the slow twin in that order, and exact layers."""

import dataclasses

import numpy as np
import pytest
from test_packets import in_packets, tile_rays

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.cpu.recording import CpuRecording
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import TraceGradients, TraceResult
from octasplat.engine.trace.reference import ReferenceParameters, trace_reference
from tests.support.trace_scenes import (
    GRADIENT_TOLERANCE,
    OUTPUTS,
    PARAMETERS,
    VALUE_TOLERANCE,
    f32,
    facing_z,
    hit_lists,
    make_cloud,
    make_tracer,
    random_gradients,
    reference_gradients,
    relative_error,
    same_bits,
    scattered,
    unit,
)

SEEN = ("rgb_srgb", "transmittance", "depth_sum", "depth_median", "normal_world")


def given_by(rng: np.random.Generator, rays: int) -> TraceGradients:
    """Random gradients by colors and transmittances, and errors."""
    every = random_gradients(rng, rays)
    return TraceGradients(every.rgb_srgb, every.transmittance, ray_errors=every.ray_errors)


def layers(rng: np.random.Generator, count: int) -> tuple[FlatGaussians, RayBatch]:
    """Octagons in parallel planes, which all rays of a window meet in the same order."""
    means = np.concatenate([rng.uniform(-0.5, 0.5, (count, 2)), rng.uniform(-1, 1, (count, 1))], axis=1)
    flat = facing_z(means, scales=rng.uniform(0.05, 0.3, (count, 2)), opacities=rng.uniform(0.05, 0.6, count))
    flat.sh = f32(rng.normal(size=(count, 9, 3)) * 0.2)
    a, b = (grid.reshape(-1, 1) for grid in np.meshgrid(*[np.linspace(-0.1, 0.1, 8)] * 2))
    directions = f32(unit(np.concatenate([a, b, np.ones_like(a)], axis=1)))
    return flat, RayBatch(np.tile(f32([0, 0, -3]), (64, 1)), directions)


def ranks_of(seen: TraceResult, gaussians: int) -> np.ndarray:
    """Where each ray composites each Gaussian, as its recording says; last what it has not met."""
    ranks = np.full((len(seen.hit_counts), gaussians), gaussians)
    for ray, ids in enumerate(hit_lists(seen)):
        ranks[ray, ids] = np.arange(len(ids))
    return ranks


def contradictions(lists: list[list[int]], gaussians: int) -> int:
    """Pairs of Gaussians that some of these rays see in one order and some in the other."""
    before = np.zeros((gaussians, gaussians), bool)
    for ids in lists:
        for place, one in enumerate(ids):
            before[one, ids[place + 1 :]] = True
    return int((before & before.T).sum()) // 2


def assert_like_twin_in_order(flat: FlatGaussians, rays: RayBatch, ranks: np.ndarray | None) -> None:
    tracer = make_tracer(flat, sort="packet")
    seen = tracer.trace(rays, record=True)
    given = given_by(np.random.default_rng(5), len(rays))
    parameters = ReferenceParameters.from_gaussians(flat)
    twin = trace_reference(parameters, rays, tracer.settings, ranks)
    assert hit_lists(seen) == [ids.tolist() for ids in twin.hit_ids]
    for name in SEEN:
        expected = getattr(twin, name).detach().numpy()
        np.testing.assert_allclose(getattr(seen, name), expected, atol=VALUE_TOLERANCE * 3, err_msg=name)
    zeros = {name: np.zeros_like(getattr(seen, name)) for name in OUTPUTS}
    every = TraceGradients(**{**zeros, "rgb_srgb": given.rgb_srgb, "transmittance": given.transmittance})
    expected = reference_gradients(parameters, twin, every)
    assert seen.recording is not None
    found = scattered(tracer.backward(seen.recording, given), len(flat))
    for name in PARAMETERS:
        assert relative_error(found[name], expected[name]) < GRADIENT_TOLERANCE, name


def test_shared_sort_of_layers_is_exact(rng: np.random.Generator) -> None:
    flat, rays = layers(rng, 300)
    seen = make_tracer(flat, sort="packet").trace(rays, record=True)
    assert in_packets(seen) and seen.hit_counts.mean() > 10
    assert_like_twin_in_order(flat, rays, None)


def test_shared_sort_of_crossing_octagons_matches_reference(rng: np.random.Generator) -> None:
    cloud, rays = make_cloud(rng, 600, degree=1), tile_rays(rng, 3)
    one, each = (make_tracer(cloud, sort=way).trace(rays, record=True) for way in ("packet", "ray"))
    assert isinstance(one.recording, CpuRecording)
    for first, last in one.recording.packets:
        assert contradictions(hit_lists(one)[first:last], len(cloud)) == 0
    assert contradictions(hit_lists(each)[slice(*one.recording.packets[0])], len(cloud)) > 0
    assert_like_twin_in_order(cloud, rays, ranks_of(one, len(cloud)))


def test_narrow_packet_keeps_ray_order(rng: np.random.Generator) -> None:
    cloud, rays = make_cloud(rng, 1000), tile_rays(rng, 4, width=1e-5)
    one, each = (make_tracer(cloud, sort=order).trace(rays, record=True) for order in ("packet", "ray"))
    assert hit_lists(one) == hit_lists(each)
    for name in SEEN:
        np.testing.assert_allclose(getattr(one, name), getattr(each, name), atol=2e-5, err_msg=name)


def test_shared_sort_partial_packets_and_limits_match(rng: np.random.Generator) -> None:
    flat, rays = layers(rng, 200)
    some = RayBatch(rays.origins_world[:37], rays.directions_world[:37], f32(2.5), f32(3.4))
    for options in ({}, {"max_hits": 3}, {"transmittance_min": 0.3}, {"alpha_max": 0.3}):
        one, each = (
            make_tracer(flat, sort=way, **options).trace(some, record=True) for way in ("packet", "ray")
        )
        assert hit_lists(one) == hit_lists(each), options
        assert one.hit_counts.max() > 0
        np.testing.assert_allclose(one.rgb_srgb, each.rgb_srgb, atol=2e-6)


def test_shared_sort_clamped_alpha_has_no_gradient(rng: np.random.Generator) -> None:
    flat, rays = layers(rng, 100)
    found = []
    for way in ("packet", "ray"):
        tracer = make_tracer(flat, sort=way, alpha_max=0.2)
        seen = tracer.trace(rays, record=True)
        assert seen.recording is not None
        found.append(tracer.backward(seen.recording, given_by(np.random.default_rng(1), len(rays))))
    for name in ("means_world", "opacity_logits", "sh", "weight_sums", "error_sums"):
        assert relative_error(getattr(found[0], name), getattr(found[1], name)) < 2e-5, name


def test_shared_sort_is_bit_identical_across_threads(rng: np.random.Generator) -> None:
    cloud, rays = make_cloud(rng, 2000, degree=1), tile_rays(rng, 12)
    given = given_by(rng, len(rays))
    results, gradients = [], []
    for threads in (1, 2):
        tracer = make_tracer(cloud, sort="packet", threads=threads)
        for _ in range(2):  # the first time, there is no room for what is met
            seen = tracer.trace(rays, record=True)
            assert seen.recording is not None
            gradients.append(tracer.backward(seen.recording, given))
            results.append(dataclasses.replace(seen, recording=None))
    for k in range(1, 4):
        same_bits(results[0], results[k])
        same_bits(gradients[0], gradients[k])
    same_bits(results[0], dataclasses.replace(make_tracer(cloud, sort="packet").trace(rays), recording=None))


def test_recordings_live_side_by_side(rng: np.random.Generator) -> None:
    cloud, rays = make_cloud(rng, 1000), tile_rays(rng, 8)
    tracer = make_tracer(cloud, sort="packet")
    given = given_by(rng, 4 * 64)
    first, second = (tracer.trace(rays[part], record=True) for part in (slice(0, 256), slice(256, 512)))
    first.transmittance[:] = 0.0  # a recording does not hang on what its results become
    alone = make_tracer(cloud, sort="packet")
    again = alone.trace(rays[:256], record=True)
    assert first.recording is not None and again.recording is not None and second.recording is not None
    same_bits(tracer.backward(first.recording, given), alone.backward(again.recording, given))


def test_shared_sort_skips_low_blend_weights(rng: np.random.Generator) -> None:
    cloud, rays = make_cloud(rng, 1000), tile_rays(rng, 4)
    tracer = make_tracer(cloud, sort="packet")
    seen = tracer.trace(rays, record=True)
    assert seen.recording is not None
    given = given_by(rng, len(rays))
    every, some = (tracer.backward(seen.recording, given, min_blend_weight=least) for least in (0.0, 0.5))
    assert 0 < len(some.ids) < len(every.ids)
    np.testing.assert_array_equal(some.ids, every.ids[every.weight_sums >= 0.5])


@pytest.mark.parametrize("second_phase_min", [None, 0.01])
def test_features_and_second_phases_go_by_ray(
    rng: np.random.Generator, second_phase_min: float | None
) -> None:
    cloud, rays = make_cloud(rng, 500), tile_rays(rng, 2)
    features = f32(rng.normal(size=(500, 2))) if second_phase_min is None else None
    one, each = (
        make_tracer(cloud, features, sort=way, second_phase_min=second_phase_min).trace(rays)
        for way in ("packet", "ray")
    )
    same_bits(one, each)


def test_gradients_by_depths_are_refused(rng: np.random.Generator) -> None:
    tracer, rays = make_tracer(make_cloud(rng, 100), sort="packet"), tile_rays(rng, 1)
    seen = tracer.trace(rays, record=True)
    assert seen.recording is not None
    with pytest.raises(ValueError, match="sort='ray'"):
        tracer.backward(seen.recording, random_gradients(rng, len(rays)))


def test_rays_alone_beside_packets(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 500)
    tile = tile_rays(rng, 1)
    lone = RayBatch(f32(rng.normal(size=(30, 3)) * 3), f32(unit(rng.normal(size=(30, 3)))))
    both = RayBatch(
        np.concatenate([np.broadcast_to(tile.origins_world, (64, 3)), lone.origins_world]),
        np.concatenate([tile.directions_world, lone.directions_world]),
    )
    tracer = CpuTracer(make_tracer(cloud, sort="packet").settings)
    tracer.build(cloud)
    seen = tracer.trace(both, record=True)
    given = given_by(rng, len(both))
    assert seen.recording is not None
    found = scattered(tracer.backward(seen.recording, given), 500)
    total = {name: np.zeros_like(value) for name, value in found.items()}
    for part in (slice(0, 64), slice(64, None)):
        some = tracer.trace(both[part], record=True)
        np.testing.assert_allclose(some.rgb_srgb, seen.rgb_srgb[part], atol=2e-6)
        mine = TraceGradients(
            given.rgb_srgb[part],
            np.asarray(given.transmittance)[part],
            ray_errors=np.asarray(given.ray_errors)[part],
        )
        assert some.recording is not None
        for name, value in scattered(tracer.backward(some.recording, mine), 500).items():
            total[name] += value
    for name, value in found.items():
        assert relative_error(value, total[name]) < 1e-5, name
