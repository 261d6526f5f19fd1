"""The CPU tracer against its slow twin: hit lists, values, and gradients through every output."""

import numpy as np
import pytest

from octasplat.engine.core.rays import AT_INFINITY, RayBatch
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.trace.cpu.kernels.octagon_hit import HIT_BUFFER_SIZE
from octasplat.engine.trace.cpu.recording import CpuRecording
from octasplat.engine.trace.protocol import TraceGradients
from tests.support.trace_scenes import (
    GRADIENT_TOLERANCE,
    PARAMETERS,
    assert_matches_reference,
    f32,
    facing_z,
    hit_lists,
    in_plane,
    make_cloud,
    make_tracer,
    random_gradients,
    rays_inwards,
    reference_in_chunks,
    relative_error,
    scattered,
    unit,
)

pytestmark = pytest.mark.usefixtures("both_ways")


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_cloud_with_harmonics_and_features(rng: np.random.Generator, degree: int) -> None:
    cloud = make_cloud(rng, 1000, degree=degree)
    features = f32(rng.normal(size=(1000, degree)))
    ours, found = assert_matches_reference(cloud, rays_inwards(rng, 250), features=features)
    assert ours.hit_counts.mean() > 10
    assert (ours.rgb_srgb.max(axis=0) > 0.5).all()
    assert np.abs(found["sh"]).max() > 0


@pytest.mark.parametrize("degree", [1, 3])
def test_arbitrary_view_origins_match_reference(rng: np.random.Generator, degree: int) -> None:
    # Within the cloud, where it matters: some at the origin, some behind it, some infinitely far away.
    inwards = rays_inwards(rng, 120, distance=0.5)
    viewers = rng.choice([0.0, -0.4, -3.0, AT_INFINITY], 120)
    rays = RayBatch(inwards.origins_world, inwards.directions_world, t_view_origin=viewers)
    assert_matches_reference(make_cloud(rng, 1000, degree=degree), rays)


def test_reference_one_sided_normals(rng: np.random.Generator) -> None:
    cloud, rays = make_cloud(rng, 1000), rays_inwards(rng, 250)
    ours, _ = assert_matches_reference(cloud, rays, flip_normal_cos=0.4)
    all_turned = make_tracer(cloud).trace(rays)
    assert np.abs(ours.normal_world - all_turned.normal_world).max() > 0.1
    assert np.array_equal(ours.rgb_srgb, all_turned.rgb_srgb)


def test_rays_from_surface_match_reference(rng: np.random.Generator) -> None:
    inwards = rays_inwards(rng, 120, distance=0.5)
    leaves = rng.choice([0.0, 0.3, np.inf], 120)
    rays = RayBatch(inwards.origins_world, inwards.directions_world, t_backface_cull=leaves)
    cloud = make_cloud(rng, 1000)
    ours, _ = assert_matches_reference(cloud, rays, flip_normal_cos=0.5)
    before = make_tracer(cloud).trace(inwards)
    assert np.array_equal(ours.hit_counts[leaves == 0], before.hit_counts[leaves == 0])
    assert ours.hit_counts[leaves > 1].mean() < 0.7 * before.hit_counts[leaves > 1].mean()
    left = make_tracer(cloud, flip_normal_cos=0.5).transmittance(rays)
    np.testing.assert_allclose(left, np.where(ours.transmittance < 1e-3, 0, ours.transmittance), atol=1e-5)
    without_sides, _ = assert_matches_reference(cloud, rays)
    assert np.array_equal(without_sides.hit_counts, before.hit_counts)


def test_quaternions_of_any_length(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 1000)
    cloud.quats_wxyz *= f32(10 ** rng.uniform(-3, 3, (1000, 1)))
    tracer = make_tracer(cloud)
    rays = rays_inwards(rng, 250)
    # The gradient by a quaternion falls with its length, so that the short ones would hide the others.
    given = random_gradients(rng, 250)
    ours = tracer.trace(rays, record=True)
    assert ours.recording is not None
    found = scattered(tracer.backward(ours.recording, given), 1000)
    ids, _, expected = reference_in_chunks(cloud, rays, tracer.settings, given=given)
    assert hit_lists(ours) == ids
    length = np.linalg.norm(cloud.quats_wxyz, axis=1, keepdims=True)
    assert relative_error(found["quats_wxyz"] * length, expected["quats_wxyz"] * length) < GRADIENT_TOLERANCE
    along = (found["quats_wxyz"] * cloud.quats_wxyz).sum(axis=1)
    assert np.abs(along).max() < 1e-5 * np.abs(found["quats_wxyz"] * length).max()


@pytest.mark.parametrize(("stretch", "gradient_tolerance"), [(0.7, 1e-3), (2.0, 1e-3)])
def test_needles_match_reference(rng: np.random.Generator, stretch: float, gradient_tolerance: float) -> None:
    # Axes are kept in 24 bits: an error along the needle's length is one of many of its widths.
    cloud = make_cloud(rng, 1000)
    cloud.log_scales += f32([stretch, -stretch])
    assert_matches_reference(cloud, rays_inwards(rng, 250), gradient_tolerance=gradient_tolerance)


def grazing_rays(
    rng: np.random.Generator, cloud: FlatGaussians, count: int, cosines: tuple[float, float]
) -> RayBatch:
    """Rays nearly parallel to the plane of a Gaussian, aimed at a point close to its centre."""
    chosen = rng.integers(0, len(cloud), count)
    frames = cloud.rotations[chosen].astype(np.float64)
    angle = rng.uniform(0, 2 * np.pi, (count, 1))
    along = np.cos(angle) * frames[:, :, 1] + np.sin(angle) * frames[:, :, 2]
    cosine = np.exp(rng.uniform(*np.log(cosines), (count, 1))) * rng.choice([-1, 1], (count, 1))
    directions = unit(along + cosine * frames[:, :, 0])
    target = cloud.means_world[chosen] + 0.02 * rng.normal(size=(count, 3)) * 0.5
    return RayBatch(target - 3.0 * directions, directions)


def test_grazing_rays_match_reference(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 1000, size=0.1)
    assert_matches_reference(cloud, grazing_rays(rng, cloud, 250, (1e-2, 0.1)))


def test_extremely_grazing_rays_hit_the_same(rng: np.random.Generator) -> None:
    # The record's normal has 24 bits, so that precision falls with the cosine: 6e-8 / 1e-5 at the worst.
    cloud = make_cloud(rng, 1000, size=0.1)
    rays = grazing_rays(rng, cloud, 250, (1e-5, 1e-2))
    assert_matches_reference(cloud, rays, value_tolerance=2e-5, gradient_tolerance=1e-3)


def test_ray_inside_a_plane_does_not_hit_it() -> None:
    tracer = make_tracer(facing_z([0.0, 0.0, 0.0]))
    inside = tracer.trace(RayBatch(f32([[-3.0, 0.0, 0.0]]), f32([[1.0, 0.0, 0.0]])))
    assert inside.hit_counts.tolist() == [0]
    assert np.isfinite(inside.depth_sum).all()


def test_coincident_planes_and_stacks_are_ordered_by_id(rng: np.random.Generator) -> None:
    plane = in_plane(rng, 400)
    higher = in_plane(rng, 200, z=0.125)
    # Stacks: one centre and orientation each, with scales and opacities of their own.
    stack = in_plane(rng, 20, z=-0.25).select(np.repeat(np.arange(20), 20))
    stack.log_scales = f32(np.log(0.4) + 0.3 * rng.normal(size=(400, 2)))
    stack.opacity_logits = f32(rng.uniform(-3, 0, 400))
    scene = concatenate([plane, higher, stack]).select(rng.permutation(1000))
    origins = f32(
        np.concatenate([rng.uniform(-0.7, 0.7, (250, 2)), np.where(rng.random((250, 1)) < 0.5, 2, -2)], 1)
    )
    targets = np.concatenate([rng.uniform(-0.7, 0.7, (250, 2)), np.zeros((250, 1))], 1)
    ours, _ = assert_matches_reference(scene, RayBatch(origins, unit(targets - origins)))
    assert isinstance(ours.recording, CpuRecording)
    ties = 0
    for ray in range(250):
        rows = ours.recording.hit_slice(ray)
        ids, distances = ours.recording.ids_of_ray(ray), ours.recording.hits.distances[rows]
        equal = np.diff(distances) == 0
        assert (np.diff(distances) >= 0).all()
        assert (np.diff(ids)[equal] > 0).all()
        ties += int(equal.sum())
    assert ties > 1000


@pytest.mark.parametrize("second_phase_min", [None, 1e-2])
def test_opaque_stacks_with_clamped_alpha(rng: np.random.Generator, second_phase_min: float | None) -> None:
    cloud = make_cloud(rng, 1000, size=0.15, logits=(4.0, 12.0))
    # Not 0.9, for the powers of its complement would lie on the thresholds.
    ours, _ = assert_matches_reference(
        cloud, rays_inwards(rng, 200), alpha_max=0.93, second_phase_min=second_phase_min
    )
    assert isinstance(ours.recording, CpuRecording)
    recording = ours.recording
    clamped = [
        (recording.hits.alphas[recording.hit_slice(ray)] == np.float32(0.93)).sum() for ray in range(200)
    ]
    assert sum(clamped) > 50
    assert ours.transmittance.min() < 1e-3


def test_clamped_alpha_has_no_gradient() -> None:
    opaque = facing_z([0.0, 0.0, 0.0], opacities=0.999)
    rays = RayBatch(f32([[0.0, 0.0, -2.0], [0.0, 0.5, -2.0]]), f32([[0.0, 0.0, 1.0]] * 2))
    for ray, clamped in ((0, True), (1, False)):
        tracer = make_tracer(opaque, alpha_max=0.95)
        seen = tracer.trace(rays[ray : ray + 1], record=True)
        assert bool(seen.transmittance[0] == pytest.approx(0.05, rel=1e-5)) is clamped
        assert seen.recording is not None
        gradients = tracer.backward(seen.recording, TraceGradients(f32([[1.0, 1.0, 1.0]])))
        assert bool(gradients.opacity_logits[0] == 0) is clamped
        assert gradients.sh[0, 0, 0] > 0


def test_distant_small_gaussians_match_reference(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 1000, size=0.02, radius=0.3)
    assert_matches_reference(cloud, rays_inwards(rng, 200, distance=20.0, spread=0.3))


def test_scene_far_from_the_origin(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 1000)
    rays = rays_inwards(rng, 200)
    shift = f32([100.0, -50.0, 30.0])
    cloud.means_world += shift
    assert_matches_reference(cloud, RayBatch(rays.origins_world + shift, rays.directions_world))


@pytest.mark.parametrize(
    "options",
    [
        {"transmittance_min": 0.2},
        {"transmittance_min": 0.2, "second_phase_min": 0.3},
        {"transmittance_min": 1e-2, "second_phase_min": 1e-2},
        {"max_hits": 7},
        {"max_hits": HIT_BUFFER_SIZE + 1},
        {"q": 4.0},
        {"q": 11.3449},
    ],
)
def test_cutoff_settings_match_reference(rng: np.random.Generator, options: dict[str, float]) -> None:
    cloud = make_cloud(rng, 1000, size=0.12, logits=(-3.0, 2.0))
    ours, _ = assert_matches_reference(cloud, rays_inwards(rng, 120), **options)
    assert ours.hit_counts.max() <= options.get("max_hits", 512)


@pytest.mark.parametrize(
    ("options", "ids"),
    [
        ({"transmittance_min": 0.25}, [0, 1, 2]),
        ({"transmittance_min": 0.6, "second_phase_min": 0.25}, [0, 1, 2, 3]),
        ({"transmittance_min": 0.01, "q": -2 * np.log(0.5)}, []),
    ],
)
def test_stack_that_meets_limits_exactly(options: dict[str, float], ids: list[int]) -> None:
    halves = facing_z([[0, 0, z] for z in (1.0, 2.0, 3.0, 4.0, 5.0)], opacities=0.5)
    seen, _ = assert_matches_reference(halves, RayBatch(f32([[0, 0, 0]]), f32([[0, 0, 1]])), **options)
    assert hit_lists(seen) == [ids]
    assert seen.depth_median[0] == (1 if ids else 0)


def test_back_at_the_cull_distance_is_hit() -> None:
    backs = facing_z([[0, 0, z] for z in (1.0, 2.0, 3.0)], opacities=0.5)
    rays = RayBatch(f32([[0, 0, 0]]), f32([[0, 0, 1]]), t_backface_cull=2.0)
    seen, _ = assert_matches_reference(backs, rays, flip_normal_cos=0.5)
    assert hit_lists(seen) == [[1, 2]]


@pytest.mark.parametrize("options", [{}, {"max_hits": 200}, {"second_phase_min": 0.9}])
def test_rays_with_more_hits_than_one_traversal_gathers(
    rng: np.random.Generator, options: dict[str, float]
) -> None:
    faint = make_cloud(rng, 1200, size=0.5, logits=(-4.4, -3.2))
    stack = in_plane(rng, 1).select(np.zeros(300, int))
    stack.opacity_logits = f32(rng.uniform(-4.4, -3.2, 300))
    scene = concatenate([faint, stack])
    ours, _ = assert_matches_reference(scene, rays_inwards(rng, 80), **options)
    assert np.quantile(ours.hit_counts, 0.5) > 2 * HIT_BUFFER_SIZE


def test_opaque_gaussian_behind_many_faint_ones(rng: np.random.Generator) -> None:
    heights = rng.permutation(np.linspace(-0.5, 0.5, 300))
    centres = np.concatenate([0.05 * rng.normal(size=(300, 2)), heights[:, None]], axis=1)
    opacities = np.where(heights < -0.3, 0.9, 0.02)
    scene = facing_z(centres, opacities=opacities, rgb_srgb=rng.random((300, 3)))
    origins = f32(np.tile([0.0, 0.0, 4.0], (40, 1)))
    directions = f32(unit(0.3 * rng.normal(size=(40, 3)) - origins))
    ours, _ = assert_matches_reference(scene, RayBatch(origins, directions))
    assert ours.hit_counts.max() > 3 * HIT_BUFFER_SIZE
    assert ours.transmittance.min() < 1e-3


def test_missing_gradients_count_as_zero(rng: np.random.Generator) -> None:
    cloud = make_cloud(rng, 300)
    rays = rays_inwards(rng, 60)
    tracer = make_tracer(cloud)
    hits = tracer.trace(rays, record=True).recording
    assert hits is not None
    g_rgb = f32(rng.normal(size=(60, 3)))
    found = scattered(tracer.backward(hits, TraceGradients(g_rgb)), 300)
    zeros = {
        name: np.zeros(shape, np.float32)
        for name, shape in {
            "transmittance": 60,
            "depth_sum": 60,
            "depth_median": 60,
            "normal_world": (60, 3),
            "features": (60, 0),
        }.items()
    }
    given = TraceGradients(g_rgb, **zeros)
    _, _, expected = reference_in_chunks(cloud, rays, tracer.settings, given=given)
    for name in PARAMETERS:
        np.testing.assert_allclose(
            found[name], expected[name], atol=1e-4 * np.abs(expected[name]).max(initial=0)
        )
