"""What every tracer must do, whatever it runs on: the protocol, one behaviour after another."""

import numpy as np
import pytest

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.factory import make_tracer
from octasplat.engine.trace.protocol import GradientsHandle, Recording, Tracer, TraceSettings
from tests.support.trace_scenes import (
    OUTPUTS,
    PARAMETERS,
    f32,
    facing_z,
    hit_lists,
    make_cloud,
    random_gradients,
    rays_inwards,
    reference_in_chunks,
    relative_error,
    same_bits,
    scattered,
    unit,
)

TRACERS = ("cpu", "cpu, packets", "cpu, single rays", "reference")


@pytest.fixture(params=TRACERS)
def tracer(request: pytest.FixtureRequest) -> Tracer:
    """One tracer after another, nothing built yet."""
    name, _, way = request.param.partition(", ")
    if way:
        return CpuTracer(packet_mode="always" if way == "packets" else "never")
    return make_tracer(TraceSettings(tracer=name))


def mixed_rays(rng: np.random.Generator) -> RayBatch:
    """Tiles from three origins with loose rays between them, and limits of each ray's own."""
    origins, directions = [], []
    for size in (16, 5, 1, 1, 12, 2, 1, 1, 1):
        origin = unit(rng.normal(size=3)) * 3.0
        middle = unit(0.2 * rng.normal(size=3) - origin)
        directions.append(unit(middle + 0.05 * rng.normal(size=(size, 3))))
        origins.append(np.tile(origin, (size, 1)))
    count = sum(map(len, origins))
    t_min = rng.choice([0.0, 2.6, 3.0], count)
    t_max = rng.choice([np.inf, 3.2, 3.6], count)
    return RayBatch(np.concatenate(origins), np.concatenate(directions), t_min, t_max)


def assert_like_the_twin(
    tracer: Tracer, cloud: FlatGaussians, rays: RayBatch, features: np.ndarray | None = None
) -> None:
    """Hits, values and gradients of a tracer that has been built."""
    given = random_gradients(
        np.random.default_rng(3), len(rays), 0 if features is None else features.shape[1]
    )
    ids, values, gradients = reference_in_chunks(cloud, rays, tracer.settings, features, given)
    seen = tracer.trace(rays, record=True)
    assert hit_lists(seen) == ids
    for name in OUTPUTS:
        assert relative_error(getattr(seen, name), values[name]) < 1e-5, name
    assert seen.recording is not None
    found = tracer.backward(seen.recording, given).numpy()
    assert (np.diff(found.ids) > 0).all()
    counts = np.bincount(np.concatenate([*map(np.array, ids), []]).astype(int), minlength=len(cloud))
    assert found.hit_counts.tolist() == counts[found.ids].tolist()
    dense = scattered(found, len(cloud))
    for name in PARAMETERS:
        assert relative_error(dense[name], gradients[name]) < 1e-4, name


def test_tracer_implements_protocol(tracer: Tracer, rng: np.random.Generator) -> None:
    assert isinstance(tracer, Tracer)
    cloud = make_cloud(rng, 20)
    tracer.build(cloud)
    seen = tracer.trace(rays_inwards(rng, 5), record=True)
    assert isinstance(seen.recording, Recording)
    assert isinstance(tracer.backward(seen.recording, random_gradients(rng, 5)), GradientsHandle)
    assert tracer.trace(rays_inwards(rng, 5)).recording is None


def test_groups_and_loose_rays_with_limits(tracer: Tracer, rng: np.random.Generator) -> None:
    cloud, features = make_cloud(rng, 300, degree=1, size=0.15), f32(rng.normal(size=(300, 2)))
    tracer.build(cloud, features)
    assert_like_the_twin(tracer, cloud, mixed_rays(rng), features)


def test_shared_origin_and_limits_broadcast(tracer: Tracer, rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 200, size=0.15)
    tracer.build(cloud)
    origin, directions = np.array([[0.0, 0.0, -3.0]]), unit(rng.normal(size=(30, 3)) * 0.2 + [0, 0, 1])
    one = tracer.trace(RayBatch(origin, directions, 2.5, 3.5))
    all_alike = RayBatch(np.tile(origin, (30, 1)), directions, np.full(30, 2.5), np.full(30, 3.5))
    same_bits(one, tracer.trace(all_alike))
    assert one.hit_counts.any()


def test_limits_are_open_at_both_ends(tracer: Tracer) -> None:
    tracer.build(facing_z([[0, 0, z] for z in (0.5, 1.0, 2.0)]))
    ends = [(0.5, 2.0), (0.4, 2.5), (0.0, 0.5), (1.0, 1.0), (2.0, 1.0)]
    rays = RayBatch(np.zeros((1, 3)), np.tile([[0.0, 0.0, 1.0]], (5, 1)), *np.array(ends).T)
    seen = tracer.trace(rays, record=True)
    assert hit_lists(seen) == [[1], [0, 1, 2], [], [], []]
    np.testing.assert_allclose(tracer.transmittance(rays), [0.5, 0.125, 1, 1, 1], rtol=1e-6)


def test_transmittance_includes_all_hits(tracer: Tracer, rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 400, size=0.2, logits=(-3.0, 1.0))
    tracer.build(cloud)
    rays = mixed_rays(rng)
    unlimited = TraceSettings(transmittance_min=1e-30, max_hits=4096)
    expected = reference_in_chunks(cloud, rays, unlimited)[1]["transmittance"]
    least = tracer.settings.transmittance_min
    expected[expected < least] = 0.0
    np.testing.assert_allclose(tracer.transmittance(rays), expected, rtol=1e-5)
    assert (expected == 0).any() and ((expected > least) & (expected < 1)).any()


def test_transmittance_is_symmetric(tracer: Tracer, rng: np.random.Generator) -> None:
    tracer.build(make_cloud(rng, 300, size=0.1))
    light, points = np.array([[0.3, -2.5, 0.4]]), unit(rng.normal(size=(40, 3))) * 0.7
    there = tracer.transmittance(RayBatch.between(light, points))
    back = tracer.transmittance(RayBatch.between(points, np.tile(light, (40, 1))))
    np.testing.assert_allclose(there, back, atol=2e-5)
    assert len(np.unique(there)) > 20


def test_mirrored_camera_respects_mirror_plane(tracer: Tracer, rng: np.random.Generator) -> None:
    # The plane z = -1 mirrors the cloud; a ray reflected there sees as one from the mirror's surface.
    cloud = make_cloud(rng, 300, size=0.15)
    tracer.build(cloud)
    camera = RayBatch(np.array([[0.4, 0.2, 2.0]]), unit(rng.normal(size=(30, 3)) * 0.15 + [0, 0, -1]))
    t_mirror = (-1.0 - 2.0) / camera.directions_world[:, 2]
    mirrored = camera.reflect(np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 3.0]), t_mirror)
    assert mirrored.origins_world.tolist() == [f32([0.4, 0.2, -4.0]).tolist()]
    seen = tracer.trace(mirrored)
    plain = tracer.trace(RayBatch(mirrored.starts_world, mirrored.directions_world))
    np.testing.assert_allclose(seen.rgb_srgb, plain.rgb_srgb, atol=1e-4)
    np.testing.assert_allclose(
        seen.depth_sum, plain.depth_sum + (1 - plain.transmittance) * t_mirror, rtol=1e-4
    )
    assert seen.hit_counts.any()
    assert_like_the_twin(tracer, cloud, mirrored)


@pytest.mark.parametrize("first", [0, 1])
def test_recordings_live_side_by_side(tracer: Tracer, rng: np.random.Generator, first: int) -> None:
    cloud = make_cloud(rng, 200, size=0.15)
    tracer.build(cloud)
    batches = rays_inwards(rng, 40), mixed_rays(rng)
    given = [random_gradients(np.random.default_rng(k), len(rays)) for k, rays in enumerate(batches)]
    seen = [tracer.trace(rays, record=True) for rays in batches]
    tracer.trace(rays_inwards(rng, 60), record=True)  # nobody keeps this one
    for k in (first, 1 - first):
        ids, _, expected = reference_in_chunks(cloud, batches[k], tracer.settings, given=given[k])
        hits = seen[k].recording
        assert hits is not None and hit_lists(seen[k]) == ids
        found = scattered(tracer.backward(hits, given[k]).numpy(), 200)
        for name in PARAMETERS:
            assert relative_error(found[name], expected[name]) < 1e-4, name


def test_errors_are_shared_out_by_weight(tracer: Tracer) -> None:
    tracer.build(facing_z([[0, 0, 2], [0, 0, 1]], opacities=[0.5, 0.25]))
    rays = RayBatch(np.zeros((1, 3)), np.tile([[0.0, 0.0, 1.0]], (2, 1)), t_max=f32([np.inf, 1.5]))
    hits = tracer.trace(rays, record=True).recording
    assert hits is not None
    given = random_gradients(np.random.default_rng(0), 2)
    given.ray_errors = f32([4.0, 8.0])
    found = tracer.backward(hits, given).numpy()
    np.testing.assert_allclose(found.weight_sums, [0.375, 0.5], rtol=1e-6)
    np.testing.assert_allclose(found.error_sums, [1.5, 3.0], rtol=1e-6)
    assert found.hit_counts.tolist() == [1, 2]


def test_low_weight_gaussians_have_no_gradient(tracer: Tracer, rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 40)
    rays = mixed_rays(rng)
    tracer.build(cloud)
    given = random_gradients(rng, len(rays), 0)
    hits = tracer.trace(rays, record=True).recording
    assert hits is not None
    all_of_them = tracer.backward(hits, given).numpy()
    least = float(np.median(all_of_them.weight_sums))
    some = tracer.backward(hits, given, min_blend_weight=least).numpy()
    enough = all_of_them.weight_sums >= least
    assert 0 < enough.sum() < len(enough)
    for name, rows in vars(all_of_them).items():
        assert getattr(some, name).tobytes() == rows[enough].tobytes(), name
    assert len(tracer.backward(hits, given, min_blend_weight=1e9).numpy().ids) == 0


def test_refresh_reads_changed_parameters(tracer: Tracer, rng: np.random.Generator) -> None:
    cloud, features = make_cloud(rng, 150, size=0.15), f32(rng.random((150, 2)))
    tracer.build(cloud, features)
    cloud.sh += f32(0.1 * rng.normal(size=cloud.sh.shape))
    cloud.opacity_logits -= f32(0.5)
    features *= f32(0.5)
    tracer.refresh(np.arange(150, dtype=np.int32))
    assert_like_the_twin(tracer, cloud, rays_inwards(rng, 40), features)


def test_recording_of_other_build_is_refused(tracer: Tracer, rng: np.random.Generator) -> None:
    cloud, rays = make_cloud(rng, 20), rays_inwards(rng, 5)
    tracer.build(cloud)
    hits = tracer.trace(rays, record=True).recording
    tracer.build(cloud)
    assert hits is not None
    with pytest.raises(ValueError, match="older than its last build"):
        tracer.backward(hits, random_gradients(rng, 5))


@pytest.mark.parametrize(("gaussians", "rays"), [(0, 5), (20, 0), (0, 0)])
def test_empty_scene_and_no_rays_are_traced(
    tracer: Tracer, rng: np.random.Generator, gaussians: int, rays: int
) -> None:
    tracer.build(make_cloud(rng, gaussians))
    batch = RayBatch(f32(rng.normal(size=(rays, 3))) + 9.0, unit(rng.normal(size=(rays, 3)) + 9.0))
    seen = tracer.trace(batch, record=True)
    assert seen.transmittance.tolist() == tracer.transmittance(batch).tolist() == [1.0] * rays
    assert seen.recording is not None
    assert len(tracer.backward(seen.recording, random_gradients(rng, rays)).numpy().ids) == 0


def test_unknown_tracer_is_refused() -> None:
    with pytest.raises(ValueError, match="tracer"):
        TraceSettings(tracer="cuda")
