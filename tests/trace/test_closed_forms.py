"""What a ray sees, where it can be worked out by hand."""

import numpy as np
import pytest

from octasplat.engine.core.rays import AT_INFINITY, RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.octagon import octagon_corners_world, octagon_radii
from octasplat.engine.trace.protocol import TraceGradients, TraceResult
from tests.support.trace_scenes import f32, facing_z, make_tracer

pytestmark = pytest.mark.usefixtures("both_ways")


UP = f32([[0.0, 0.0, 1.0]])


def look_up(gaussians: FlatGaussians, x: float, y: float, z: float = -2.0, **options: object) -> TraceResult:
    """A ray along z from (x, y, z)."""
    return make_tracer(gaussians, **options).trace(RayBatch(f32([[x, y, z]]), UP))


def test_alpha_at_the_centre_is_the_opacity() -> None:
    seen = look_up(facing_z([0, 0, 1], opacities=0.7, rgb_srgb=[0.2, 0.4, 0.9]), 0, 0)
    assert seen.hit_counts.tolist() == [1]
    assert seen.alpha[0] == pytest.approx(0.7, rel=1e-6)
    np.testing.assert_allclose(seen.rgb_srgb[0], 0.7 * np.array([0.2, 0.4, 0.9]), rtol=1e-6)
    assert seen.depth_sum[0] == pytest.approx(0.7 * 3, rel=1e-6)
    assert seen.expected_depth[0] == pytest.approx(3, rel=1e-6)
    assert seen.depth_median[0] == 3


def test_median_depth_needs_half_of_the_light() -> None:
    assert look_up(facing_z([0, 0, 1], opacities=0.49), 0, 0).depth_median[0] == 0
    assert look_up(facing_z([0, 0, 1], opacities=0.51), 0, 0).depth_median[0] == 3
    pair = facing_z([[0, 0, 1], [0, 0, 2]], opacities=0.4)
    assert look_up(pair, 0, 0).depth_median[0] == 4


# The axes r2, r3 of `facing_z` are y and -x.
@pytest.mark.parametrize(("x", "y"), [(0, 0.3), (0.2, 0), (-0.2, 0), (0, -0.3)])
def test_alpha_at_one_sigma_is_known(x: float, y: float) -> None:
    seen = look_up(facing_z([0, 0, 0], scales=[0.3, 0.2], opacities=0.8), x, y)
    assert seen.alpha[0] == pytest.approx(0.8 * np.exp(-0.5), rel=1e-6)


def test_oblique_ray_sees_the_gaussian_on_its_plane() -> None:
    direction = np.array([0.6, 0.0, 0.8])
    tracer = make_tracer(facing_z([0, 0, 0], opacities=0.8))
    seen = tracer.trace(
        RayBatch(f32([[-1.5, 0.0, -4.0]]), f32([direction]))
    )  # meets the plane at x = 1.5 after 5
    assert seen.alpha[0] == pytest.approx(0.8 * np.exp(-0.5 * 1.5**2), rel=1e-5)
    assert seen.expected_depth[0] == pytest.approx(5, rel=1e-6)


def test_normal_is_turned_towards_the_viewer() -> None:
    tracer = make_tracer(facing_z([0, 0, 0], opacities=0.8))
    both = tracer.trace(RayBatch(f32([[0, 0, -2], [0, 0, 2]]), f32([[0, 0, 1], [0, 0, -1]])))
    np.testing.assert_allclose(both.normal_world, 0.8 * np.array([[0, 0, -1], [0, 0, 1]]), atol=1e-6)


def test_two_gaussians_composite_front_to_back() -> None:
    pair = facing_z([[0, 0, 2], [0, 0, 1]], opacities=[0.5, 0.25], rgb_srgb=[[1, 0, 0], [0, 1, 0]])
    features = f32([[3.0], [5.0]])
    tracer = make_tracer(pair, features)
    seen = tracer.trace(RayBatch(f32([[0, 0, 0]]), UP), record=True)
    assert seen.recording is not None
    assert seen.recording.ids_of_ray(0).tolist() == [1, 0]
    np.testing.assert_allclose(seen.rgb_srgb[0], [0.75 * 0.5, 0.25, 0], atol=1e-6)
    assert seen.transmittance[0] == pytest.approx(0.375, rel=1e-6)
    assert seen.depth_sum[0] == pytest.approx(0.25 * 1 + 0.375 * 2, rel=1e-6)
    assert seen.features[0, 0] == pytest.approx(0.25 * 5 + 0.375 * 3, rel=1e-6)
    background = seen.rgb_srgb[0] + seen.transmittance[0] * np.array([1.0, 1.0, 1.0])
    np.testing.assert_allclose(background, [0.75, 0.625, 0.375], atol=1e-6)


def test_gradient_of_two_gaussians_matches_closed_form() -> None:
    pair = facing_z([[0, 0, 2], [0, 0, 1]], opacities=[0.5, 0.25], rgb_srgb=[[1, 0.2, 0], [0, 0.6, 0]])
    tracer = make_tracer(pair)
    seen = tracer.trace(RayBatch(f32([[0, 0, 0]]), UP), record=True)
    assert seen.recording is not None
    green = tracer.backward(seen.recording, TraceGradients(f32([[0, 1, 0]]), ray_errors=f32([4.0])))
    # C = b 0.6 + (1 - b) a 0.2 with a = 0.5 behind, b = 0.25 before; dC/dlogit = dC/da a (1 - a).
    assert green.ids.tolist() == [0, 1]
    np.testing.assert_allclose(
        green.opacity_logits, [0.75 * 0.2 * 0.25, (0.6 - 0.5 * 0.2) * 0.25 * 0.75], rtol=1e-5
    )
    np.testing.assert_allclose(green.sh[:, 0, 1], np.array([0.375, 0.25]) * 0.28209479, rtol=1e-5)
    assert (green.sh[:, 0, [0, 2]] == 0).all()
    np.testing.assert_allclose(green.weight_sums, [0.375, 0.25], rtol=1e-6)
    np.testing.assert_allclose(green.error_sums, [1.5, 1.0], rtol=1e-6)
    assert green.hit_counts.tolist() == [1, 1]


@pytest.mark.parametrize("opacity", [0.9, 0.1])
def test_rim_of_the_octagon(opacity: float) -> None:
    q = 9.0
    gaussian = facing_z([0.1, -0.2, 0.5], scales=[0.3, 0.2], opacities=opacity)
    corners = octagon_corners_world(gaussian, octagon_radii(gaussian.opacities, q))[0].astype(np.float64)
    centre = gaussian.means_world[0].astype(np.float64)
    rim = np.concatenate([corners, 0.5 * (corners + np.roll(corners, -1, axis=0))])
    for factor, hits in ((0.9999, 1), (1.0001, 0)):
        targets = centre + factor * (rim - centre)
        origins = f32(np.concatenate([targets[:, :2], np.full((16, 1), -2.0)], axis=1))
        seen = make_tracer(gaussian, q=q).trace(RayBatch(origins, np.repeat(UP, 16, axis=0)))
        assert seen.hit_counts.tolist() == [hits] * 16
        if hits:
            np.testing.assert_allclose(seen.alpha[:8], np.exp(-q / 2), rtol=2e-3)  # whatever the opacity


def test_faint_gaussian_has_no_octagon() -> None:
    q = 9.0
    cut = np.exp(-q / 2)
    assert look_up(facing_z([0, 0, 0], opacities=1.01 * cut), 0, 0, q=q).hit_counts[0] == 1
    assert look_up(facing_z([0, 0, 0], opacities=0.99 * cut), 0, 0, q=q).hit_counts[0] == 0


def test_nearest_distance_of_stack_is_known() -> None:
    stack = facing_z([[0, 0, z] for z in (-1.0, 0.0, 0.5, 1.0, 2.0)])
    tracer = make_tracer(stack)
    seen = tracer.trace(RayBatch(f32([[0, 0, 0]]), UP, t_min=0.5), record=True)
    assert seen.recording is not None
    assert seen.recording.ids_of_ray(0).tolist() == [3, 4]  # strictly beyond t_min
    assert look_up(stack, 0, 0, z=0.0).hit_counts[0] == 3  # behind the origin and at it: not seen


def test_color_is_clamped_at_zero_without_gradient() -> None:
    dark = facing_z([0, 0, 0], opacities=0.5, rgb_srgb=[-0.2, 0.3, 1.7])
    tracer = make_tracer(dark)
    seen = tracer.trace(RayBatch(f32([[0, 0, -1]]), UP), record=True)
    np.testing.assert_allclose(seen.rgb_srgb[0], [0, 0.15, 0.85], atol=1e-6)
    assert seen.recording is not None
    gradients = tracer.backward(seen.recording, TraceGradients(f32([[1, 1, 1]])))
    np.testing.assert_allclose(gradients.sh[0, 0], np.array([0, 0.5, 0.5]) * 0.28209479, rtol=1e-5)


def test_harmonics_are_those_of_the_direction_to_the_mean() -> None:
    lobe = facing_z([0, 0, 0], opacities=0.5, rgb_srgb=0.5)
    lobe.sh = np.concatenate([lobe.sh, np.zeros((1, 3, 3), np.float32)], axis=1)
    lobe.sh[0, 2] = [0.5, 0.0, -0.5]  # the z lobe
    swing = 0.4886025119029199 * 0.5
    front, back = [0.5 + swing, 0.5, 0.5 - swing], [0.5 - swing, 0.5, 0.5 + swing]
    # Two rays from each side: through the centre, and past it at an angle, which shows the same color.
    directions = np.array([[0, 0, 1], [0.6, 0, 2], [0, 0, -1], [0.6, 0, -2]])
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    rays = RayBatch(f32([[0, 0, -2], [0, 0, -2], [0, 0, 2], [0, 0, 2]]), f32(directions))
    seen = make_tracer(lobe).trace(rays)
    np.testing.assert_allclose(seen.alpha[[0, 2]], 0.5, rtol=1e-6)
    assert (seen.alpha[[1, 3]] < 0.49).all()
    np.testing.assert_allclose(seen.rgb_srgb / seen.alpha[:, None], [front, front, back, back], atol=1e-6)


def test_viewer_at_infinity_uses_ray_direction() -> None:
    lobe = facing_z([0, 0, 0], opacities=0.5, rgb_srgb=0.5)
    lobe.sh = np.concatenate([lobe.sh, np.zeros((1, 3, 3), np.float32)], axis=1)
    lobe.sh[0, 2] = [0.5, 0.0, -0.5]  # the z lobe
    direction = np.array([0.6, 0.0, 0.8])
    for viewer, z in ((AT_INFINITY, 0.8), (0.0, 1.0), (-5.0, 5 / np.hypot(3, 5))):
        # From (0, 0, -1): the way from the viewer at t < 0 to the mean is (0, 0, 1) - t direction.
        seen = make_tracer(lobe).trace(RayBatch(f32([[0, 0, -1]]), f32([direction]), t_view_origin=viewer))
        swing = 0.4886025119029199 * 0.5 * z
        expected = [0.5 + swing, 0.5, 0.5 - swing]
        np.testing.assert_allclose(seen.rgb_srgb[0] / seen.alpha[0], expected, atol=1e-6)


def test_trace_stops_after_transmittance_threshold() -> None:
    stack = facing_z([[0, 0, k] for k in range(1, 9)], opacities=0.5)
    # T after k: 0.5^k.
    for threshold, hits in ((0.3, 2), (0.2, 3), (0.01, 7), (1e-3, 8)):
        assert look_up(stack, 0, 0, z=0.0, transmittance_min=threshold).hit_counts[0] == hits
    # The second transmittance starts at one behind the third.
    seen = look_up(stack, 0, 0, z=0.0, transmittance_min=0.2, second_phase_min=0.3)
    assert seen.hit_counts[0] == 5
    assert seen.transmittance[0] == pytest.approx(0.5**5, rel=1e-6)


def test_pulling_a_tilted_gaussian_moves_the_depth() -> None:
    # dt/dm = r1 / <d, r1>: along a ray through a plane facing it, depth follows the mean's z.
    gaussian = facing_z([0, 0, 1], opacities=0.5)
    tracer = make_tracer(gaussian)
    seen = tracer.trace(RayBatch(f32([[0, 0, 0]]), UP), record=True)
    assert seen.recording is not None
    zero = np.zeros((1, 3), np.float32)
    by_depth = tracer.backward(seen.recording, TraceGradients(zero, depth_sum=f32([1.0])))
    np.testing.assert_allclose(by_depth.means_world[0], [0, 0, 0.5], atol=1e-6)
