"""Packets of rays: how they are found, and that they see what the slow twin and single rays see."""

from collections.abc import Iterator

import numpy as np
import pytest

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import concatenate
from octasplat.engine.trace.cpu.packets import MAX_RAYS, find_packets
from octasplat.engine.trace.cpu.recording import CpuRecording
from octasplat.engine.trace.cpu.tracer import CpuTracer
from octasplat.engine.trace.protocol import TraceResult
from tests.support import trace_scenes
from tests.support.trace_scenes import (
    assert_matches_reference,
    f32,
    facing_z,
    hit_lists,
    make_cloud,
    make_tracer,
    random_gradients,
    relative_error,
    same_bits,
    unit,
)


@pytest.fixture(autouse=True)
def always_packets() -> Iterator[None]:
    """Wide tiles make packets so small that single rays would be taken."""
    trace_scenes.PACKETS[0] = "always"
    yield
    trace_scenes.PACKETS[0] = "auto"


def tile_rays(
    rng: np.random.Generator, tiles: int, *, side: int = 8, width: float = 0.2, distance: float = 3.0
) -> RayBatch:
    """Square tiles of rays, each from a point of a sphere towards its middle."""
    origins, directions = [], []
    for _ in range(tiles):
        origin = unit(rng.normal(size=3)) * distance
        across = unit(np.cross(origin, rng.normal(size=3)))
        up = np.cross(origin / distance, across)
        middle = -origin / distance + 0.1 * rng.normal() * across
        steps = np.linspace(-width / 2, width / 2, side)
        a, b = (grid.reshape(-1, 1) for grid in np.meshgrid(steps, steps))
        directions.append(unit(middle + a * across + b * up))
        origins.append(np.broadcast_to(origin, (side * side, 3)))
    return RayBatch(np.concatenate(origins), np.concatenate(directions))


def starts(rays: RayBatch) -> list[int]:
    """First rays of the packets, and the number of rays."""
    packets, alone = find_packets(rays, "always")
    assert len(alone) == 0 and (packets[1:, 0] == packets[:-1, 1]).all()
    return [*packets[:, 0].tolist(), *packets[-1:, 1].tolist()]


def in_packets(seen: TraceResult) -> bool:
    """Whether all rays of a recorded trace went in packets."""
    assert isinstance(seen.recording, CpuRecording)
    return len(seen.recording.single_rays) == 0 and len(seen.recording.packets) > 0


def test_neighbours_with_one_origin_form_a_packet() -> None:
    origins = f32(np.repeat([[0, 0, 0], [1, 0, 0], [0, 0, 0]], [3, 2, 1], axis=0))
    directions = f32(np.tile([0, 0, 1], (6, 1)))
    assert starts(RayBatch(origins, directions)) == [0, 3, 5, 6]


def test_packet_ends_at_capacity_or_diverging_direction() -> None:
    count = MAX_RAYS + 5
    origins = np.zeros((count, 3), np.float32)
    directions = f32(np.tile([0, 0, 1], (count, 1)))
    directions[2] = [0, 1, 0]
    assert starts(RayBatch(origins, directions)) == [0, 2, 3, 3 + MAX_RAYS, count]
    assert starts(RayBatch(origins[:0], directions[:0])) == []


@pytest.mark.parametrize("degree", [0, 3])
def test_packet_tiles_match_reference(rng: np.random.Generator, degree: int) -> None:
    cloud = make_cloud(rng, 1000, degree=degree)
    features = f32(rng.normal(size=(1000, degree)))
    ours, _ = assert_matches_reference(cloud, tile_rays(rng, 4), features=features)
    assert in_packets(ours)
    assert ours.hit_counts.mean() > 10


@pytest.mark.parametrize("width", [0.01, 0.7])
def test_packet_tiles_of_any_width_match_reference(rng: np.random.Generator, width: float) -> None:
    cloud = make_cloud(rng, 1000)
    ours, _ = assert_matches_reference(cloud, tile_rays(rng, 4, width=width))
    assert in_packets(ours)


def test_rays_from_within_the_cloud(rng: np.random.Generator) -> None:
    ours, _ = assert_matches_reference(
        make_cloud(rng, 1000, size=0.15), tile_rays(rng, 4, distance=0.3, width=0.8)
    )
    assert in_packets(ours)


def test_packets_far_from_origin_match_reference(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 1000)
    rays = tile_rays(rng, 4)
    shift = f32([40.0, -25.0, 10.0])
    cloud.means_world += shift
    assert_matches_reference(cloud, RayBatch(rays.origins_world + shift, rays.directions_world))


def test_packet_candidate_buffer_grows(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 3000, size=0.3, logits=(-4.0, -2.0))
    rays = tile_rays(rng, 2, side=4)
    packets, singles = (CpuTracer(packet_mode=way) for way in ("always", "never"))
    for tracer in (packets, singles):
        tracer.build(cloud)
    a, b = (tracer.trace(rays, record=True) for tracer in (packets, singles))
    assert a.hit_counts.max() > 100
    assert in_packets(a) and not in_packets(b)
    assert hit_lists(a) == hit_lists(b)
    np.testing.assert_allclose(a.rgb_srgb, b.rgb_srgb, atol=2e-6)


def test_coincident_octagons_are_ordered_by_id(rng: np.random.Generator) -> None:
    one = facing_z([[0, 0, 0]], scales=0.5, opacities=0.3)
    many = concatenate([one] * 9)
    many.sh = f32(rng.normal(size=many.sh.shape))
    origins = np.tile(f32([0, 0, -2]), (16, 1))
    directions = f32(unit(np.concatenate([rng.uniform(-0.1, 0.1, (16, 2)), np.ones((16, 1))], axis=1)))
    tracer = make_tracer(many)
    ours = tracer.trace(RayBatch(origins, directions), record=True)
    assert in_packets(ours)
    assert hit_lists(ours) == [list(range(9))] * 16


def test_gradients_equal_those_of_single_rays(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 2000, degree=2)
    rays = tile_rays(rng, 6)
    given = random_gradients(rng, len(rays))
    found = []
    for way in ("always", "never"):
        tracer = CpuTracer(packet_mode=way)
        tracer.build(cloud)
        seen = tracer.trace(rays, record=True)
        assert seen.recording is not None
        found.append(tracer.backward(seen.recording, given))
    a, b = found
    np.testing.assert_array_equal(a.ids, b.ids)
    np.testing.assert_array_equal(a.hit_counts, b.hit_counts)
    for name in (
        "means_world",
        "quats_wxyz",
        "log_scales",
        "opacity_logits",
        "sh",
        "weight_sums",
        "error_sums",
    ):
        assert relative_error(getattr(a, name), getattr(b, name)) < 2e-5, name


def test_packets_are_bit_identical_across_threads(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 2000, degree=1)
    rays = tile_rays(rng, 12)
    given = random_gradients(rng, len(rays))
    seen, found = [], []
    for threads in (1, 2):
        tracer = CpuTracer(threads=threads)
        tracer.build(cloud)
        result = tracer.trace(rays, record=True)
        assert in_packets(result)
        assert result.recording is not None
        found.append(tracer.backward(result.recording, given))
        result.recording = None
        seen.append(result)
    same_bits(*seen)
    same_bits(*found)


def test_refresh_follows_parameters_inside_their_boxes(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 500)
    rays = tile_rays(rng, 4)
    stale, fresh = CpuTracer(box_padding=0.5), CpuTracer()
    stale.build(cloud)
    stale.trace(rays)
    moved = np.arange(0, 500, 3, dtype=np.int32)
    cloud.means_world[moved] += 0.003
    cloud.log_scales[moved] += 0.05
    cloud.opacity_logits[moved] -= 0.5
    stale.refresh(moved)
    fresh.build(cloud)
    same_bits(stale.trace(rays), fresh.trace(rays))


def test_packet_skips_vanished_gaussian(rng: np.random.Generator) -> None:
    wall = facing_z([[0, 0, 0]], scales=5.0, opacities=0.9)
    origins, directions = np.zeros((16, 3), np.float32), np.tile(f32([0, 0, 1]), (16, 1))
    origins[:, 2] = -1
    rays = RayBatch(origins, directions)
    tracer = CpuTracer()
    tracer.build(wall)
    assert (tracer.trace(rays).hit_counts == 1).all()
    wall.opacity_logits[:] = -20.0
    tracer.refresh()
    assert (tracer.trace(rays).hit_counts == 0).all()
    tracer.build(wall)
    assert (tracer.trace(rays).transmittance == 1).all()
