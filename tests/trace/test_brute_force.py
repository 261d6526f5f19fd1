"""No hit lost and none repeated: every ray against every Gaussian, by code of this test alone."""

import numpy as np
import pytest

from octasplat.engine.core.rays import RayBatch
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.trace.cpu.recording import CpuRecording
from tests.support.trace_scenes import f32, in_plane, make_cloud, make_tracer, rays_inwards, unit

pytestmark = pytest.mark.usefixtures("both_ways")


Q = 9.0
EDGE = 1e-4
"""Share of its size around an octagon's edge in which rays of a packet, in float32, may meet it or not."""
OFF = 4e-7
"""Distances of packets may be off by this, four roundings to float32, and by SLANTED."""
SLANTED = 4e-7
"""By this times the steepest slope in the packet over the cosine with the normal: that of its rounding."""


def all_hits(
    gaussians: FlatGaussians, rays: RayBatch
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Ids and float32 distances of each ray's hits, by (distance, id), with the frames in 24 bits.

    Then, of all Gaussians, how far inside the octagon's edge the ray passes, as a share of its radius and
    negative outside, and its cosine with the normal. The octagon is tested edge by edge: corners at multiples
    of 45 degrees, edge normals half-way between.
    """
    quats = gaussians.quats_wxyz.astype(np.float64)
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    normal = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1)
    axis_u = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1)
    axis_v = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1)
    scales = np.exp(gaussians.log_scales.astype(np.float64))
    normal = normal.astype(np.float32).astype(np.float64)
    axis_u = (axis_u / scales[:, :1]).astype(np.float32).astype(np.float64)
    axis_v = (axis_v / scales[:, 1:]).astype(np.float32).astype(np.float64)
    opacity = 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))
    squared = Q + 2 * np.log(opacity)
    inner = np.sqrt(np.maximum(squared, 0)) * np.cos(np.pi / 8)
    inner = np.where(squared > 0, inner.astype(np.float32), -1.0)
    means = gaussians.means_world.astype(np.float64)
    edge_angles = np.pi / 8 + np.pi / 4 * np.arange(4)
    result = []
    for start in range(0, len(rays), 100):
        part = rays[start : start + 100]
        o, d = part.origins_world.astype(np.float64), part.directions_world.astype(np.float64)
        cosine = d @ normal.T
        distance = ((means * normal).sum(1) - o @ normal.T) / cosine
        u = o @ axis_u.T - (means * axis_u).sum(1) + distance * (d @ axis_u.T)
        v = o @ axis_v.T - (means * axis_v).sum(1) + distance * (d @ axis_v.T)
        farthest = np.max([np.abs(u * np.cos(e) + v * np.sin(e)) for e in edge_angles], axis=0)
        t = distance.astype(np.float32)
        hit = (farthest <= inner) & (t > 0) & (np.abs(cosine) >= 1e-6)
        for row in range(len(o)):
            ids = np.flatnonzero(hit[row])
            ids = ids[np.lexsort((ids, t[row, ids]))]
            result.append((ids, t[row, ids], 1 - farthest[row] / inner, np.abs(cosine[row])))
    return result


def assert_same_hits(gaussians: FlatGaussians, rays: RayBatch, *, steepest: float = 0.0) -> int:
    """The hits of single rays to the bit, those of packets but for rounding; returns how many there are.

    ``steepest`` is the largest slope of a ray against the axis of its packet.
    """
    tracer = make_tracer(gaussians, q=Q, transmittance_min=1e-300, max_hits=2048)
    found = tracer.trace(rays, record=True)
    recording = found.recording
    assert isinstance(recording, CpuRecording)
    total = unsure = 0
    for ray, (ids, distances, inside, cosine) in enumerate(all_hits(gaussians, rays)):
        met, met_at = recording.ids_of_ray(ray), recording.hits.distances[recording.hit_slice(ray)]
        total += len(ids)
        if ray in recording.single_rays:
            assert met.tolist() == ids.tolist(), f"ray {ray}"
            np.testing.assert_array_equal(met_at, distances)
            continue
        assert len(np.unique(met)) == len(met), "none repeated"
        assert (np.lexsort((met, met_at)) == np.arange(len(met))).all(), "by distance, then by id"
        other = np.setxor1d(met, ids)
        unsure += len(other)
        assert (np.abs(inside[other]) < EDGE).all(), f"ray {ray}"
        both, one, two = np.intersect1d(met, ids, return_indices=True)
        allowed = (OFF + SLANTED * steepest / cosine[both]) * distances[two]
        assert (np.abs(met_at[one].astype(np.float64) - distances[two]) <= allowed).all(), f"ray {ray}"
    assert unsure <= 2 + 1e-4 * total
    return total


@pytest.mark.exhaustive
@pytest.mark.heavy
def test_ten_thousand_rays_through_a_cloud(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 3000)
    assert assert_same_hits(cloud, rays_inwards(rng, 10_000)) > 300_000


def test_tile_rays_find_brute_force_hits(rng: np.random.Generator) -> None:
    cloud = concatenate([make_cloud(rng, 1500), make_cloud(rng, 200, size=3.0, logits=(-3.0, -1.0))])
    across = np.linspace(-0.1, 0.1, 8)
    a, b = (grid.ravel() for grid in np.meshgrid(across, across))
    tiles = []
    for _ in range(12):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        tiles.append(unit(np.stack([a, b, np.ones(64)], axis=1)) @ turn)
    directions = np.concatenate(tiles)
    origins = f32(np.repeat([-3.0 * tile.mean(axis=0) for tile in tiles], 64, axis=0))
    rays = RayBatch(origins, f32(directions))
    assert assert_same_hits(cloud, rays, steepest=0.15) > 12 * 64 * 50


def test_hits_beyond_traversal_capacity_are_found(rng: np.random.Generator) -> None:
    cloud = concatenate([make_cloud(rng, 1500, size=0.3), in_plane(rng, 500, size=0.5)])
    assert assert_same_hits(cloud, rays_inwards(rng, 300)) > 300 * 200


def test_distant_small_gaussians_are_hit(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 3000, size=0.01, radius=0.1)
    assert assert_same_hits(cloud, rays_inwards(rng, 1000, distance=10.0, spread=0.1)) > 30_000


def test_axis_aligned_planes_and_rays(rng: np.random.Generator) -> None:
    planes = concatenate([in_plane(rng, 300, z=z) for z in (-0.5, 0.0, 0.5)])
    xy = rng.uniform(-0.5, 0.5, (400, 2))
    origins = f32(np.concatenate([xy, np.full((400, 1), 3.0)], axis=1))
    straight = np.tile([0.0, 0.0, -1.0], (400, 1))
    slanted = unit(straight + np.array([0.5, 0.0, 0.0]))
    directions = f32(np.where(rng.random((400, 1)) < 0.5, straight, slanted))
    assert assert_same_hits(planes, RayBatch(origins, directions)) > 10_000


def test_rays_starting_inside_cloud(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 2000)
    origins = f32(0.5 * rng.normal(size=(500, 3)))
    assert assert_same_hits(cloud, RayBatch(origins, f32(unit(rng.normal(size=(500, 3)))))) > 5000
