from collections.abc import Callable

import numpy as np
import pytest

from octasplat.engine.gaussians.frames import quaternions_from_matrices, rotation_matrices
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.gaussians.octagon import (
    CHI2_2_99,
    CHI2_3_99,
    frames_from_octagons,
    octagon_corners_world,
    octagon_radii,
    octagon_triangles,
)

Make = Callable[..., FlatGaussians]


def covariances(quats_wxyz: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    legs = (
        rotation_matrices(quats_wxyz.astype(np.float64))[:, :, 1:]
        * np.exp(log_scales.astype(np.float64))[:, None]
    )
    return legs @ legs.transpose(0, 2, 1)


def relative_error(actual: np.ndarray, expected: np.ndarray) -> float:
    return float(
        (np.linalg.norm(actual - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))).max()
    )


def test_corners_of_an_axis_aligned_gaussian_are_those_of_the_paper() -> None:
    g = FlatGaussians(
        np.array([[1, 2, 3]], np.float32),
        np.array([[2, 0, 0, 0]], np.float32),
        np.log(np.array([[2, 0.5]], np.float32)),
        np.zeros(1, np.float32),
        np.zeros((1, 1, 3), np.float32),
    )
    corners = octagon_corners_world(g, np.array([3.0], np.float32))[0]
    h = np.sqrt(0.5)
    np.testing.assert_allclose(corners[0], [1, 2 + 6, 3], rtol=1e-6)
    np.testing.assert_allclose(corners[1], [1, 2 + 6 * h, 3 + 1.5 * h], rtol=1e-6)
    np.testing.assert_allclose(corners[2], [1, 2, 3 + 1.5], rtol=1e-6)
    np.testing.assert_allclose(corners[4], [1, 2 - 6, 3], rtol=1e-6)
    np.testing.assert_allclose(corners[6], [1, 2, 3 - 1.5], rtol=1e-6)


@pytest.mark.parametrize("q", [4.0, CHI2_2_99, CHI2_3_99])
def test_octagon_corner_alpha_is_independent_of_opacity(make_gaussians: Make, q: float) -> None:
    g = make_gaussians(300)
    radii = octagon_radii(g.opacities, q)
    assert (radii > 0).any()
    offsets = octagon_corners_world(g, radii).astype(np.float64) - g.means_world[:, None]
    local = np.einsum("nij,nki->nkj", g.rotations.astype(np.float64), offsets)
    u, v = local[..., 1] / g.scales[:, :1], local[..., 2] / g.scales[:, 1:]
    alpha = g.opacities[:, None] * np.exp(-(u**2 + v**2) / 2)
    has_octagon = g.opacities > np.exp(-q / 2)
    np.testing.assert_allclose(alpha[has_octagon], np.exp(-q / 2), rtol=2e-3)
    np.testing.assert_array_equal(radii > 0, has_octagon)


def test_opaque_gaussians_have_the_papers_radius_and_invisible_ones_none() -> None:
    radii = octagon_radii(np.array([1.0, np.exp(-CHI2_3_99 / 2), 1e-9, 0.0]), CHI2_3_99)
    np.testing.assert_allclose(radii, [np.sqrt(CHI2_3_99), 0, 0, 0], atol=1e-7)


def test_fan_triangles_tile_the_octagon_without_overlap() -> None:
    triangles = octagon_triangles(3)
    assert triangles.shape == (18, 3)
    np.testing.assert_array_equal(triangles[:2], [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(triangles[5:7], [[0, 6, 7], [8, 9, 10]])
    angles = 2 * np.pi * np.arange(24) / 8
    xy = np.stack([np.cos(angles), np.sin(angles)], axis=-1)[triangles]
    a, b = xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0]
    areas = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2
    assert (areas > 0).all()
    assert areas.sum() == pytest.approx(3 * 2 * np.sqrt(2))


def test_octagon_fit_of_unmoved_corners_is_exact(make_gaussians: Make) -> None:
    g = make_gaussians(500)
    radii = octagon_radii(g.opacities)
    means, quats, log_scales, good = frames_from_octagons(octagon_corners_world(g, radii), radii)
    np.testing.assert_array_equal(good, radii > 0)
    np.testing.assert_allclose(means[good], g.means_world[good], atol=1e-6)
    np.testing.assert_allclose(log_scales[good], g.log_scales[good], atol=1e-3)
    unit = g.quats_wxyz / np.linalg.norm(g.quats_wxyz, axis=1, keepdims=True)
    agreement = np.abs(np.sum(unit * quats, axis=1))[good]
    np.testing.assert_allclose(agreement, 1.0, atol=1e-6)


def test_rigid_motion_and_uniform_scale_carry_over(make_gaussians: Make) -> None:
    g = make_gaussians(200, seed=3)
    g.opacity_logits[:] = 2.0
    radii = octagon_radii(g.opacities)
    turn = rotation_matrices(np.array([[0.3, -0.5, 0.7, 0.2]]))[0]
    shift, size = np.array([0.5, -1.0, 2.0]), 1.7
    moved = octagon_corners_world(g, radii).astype(np.float64) @ turn.T * size + shift
    means, quats, log_scales, good = frames_from_octagons(moved, radii)
    assert good.all()
    np.testing.assert_allclose(means, g.means_world @ turn.T * size + shift, atol=1e-6)
    np.testing.assert_allclose(log_scales, g.log_scales + np.log(size), atol=2e-3)
    np.testing.assert_allclose(rotation_matrices(quats), turn @ g.rotations, atol=5e-3)
    expected = size**2 * turn @ covariances(g.quats_wxyz, g.log_scales) @ turn.T
    assert relative_error(covariances(quats, log_scales), expected) < 2e-3


def test_octagon_fit_drops_shear() -> None:
    g = FlatGaussians(
        np.zeros((1, 3), np.float32),
        np.array([[1, 0, 0, 0]], np.float32),
        np.zeros((1, 2), np.float32),
        np.zeros(1, np.float32),
        np.zeros((1, 1, 3), np.float32),
    )
    corners = octagon_corners_world(g, np.ones(1, np.float32)).astype(np.float64)
    corners[..., 1] += 0.5 * corners[..., 2]  # y += z / 2: r2 = y stays, r3 = z leans towards it
    _, quats, log_scales, good = frames_from_octagons(corners, np.ones(1))
    assert good.all()
    np.testing.assert_allclose(log_scales, [[0, 0]], atol=1e-6)
    np.testing.assert_allclose(rotation_matrices(quats)[0], np.eye(3), atol=1e-6)


@pytest.mark.parametrize("centre", [0.0, 100.0])
def test_octagon_fit_flags_crumpled_octagons_only(make_gaussians: Make, centre: float) -> None:
    g = make_gaussians(9, seed=4)
    g.opacity_logits[:] = 3.0
    g.log_scales[:] = [[-1.0, -1.5]]
    g.means_world += np.float32(centre)
    radii = octagon_radii(g.opacities)
    corners = octagon_corners_world(g, radii)
    corners[0] = corners[0, 3]  # a point
    line = np.array([0.3, 0.5, 0.7], np.float32)
    corners[1] = g.means_world[1] + np.linspace(-1, 1, 8, dtype=np.float32)[:, None] * line
    corners[2, 5] = np.nan  # a corner that the way back does not use
    corners[3, 0] = np.nan
    corners[4, 6] = np.inf
    radii[5] = 0.0
    _, quats, log_scales, good = frames_from_octagons(corners, radii)
    assert not good[:6].any() and good[6:].all()
    np.testing.assert_array_equal(quats[~good], np.broadcast_to([1, 0, 0, 0], (int((~good).sum()), 4)))
    np.testing.assert_array_equal(log_scales[~good], 0)
    assert np.isfinite(quats).all() and np.isfinite(log_scales).all()


def test_octagon_fit_of_flipped_corners_flips_normal(make_gaussians: Make) -> None:
    g = make_gaussians(20, seed=5)
    g.opacity_logits[:] = 3.0
    radii = octagon_radii(g.opacities)
    mirrored = octagon_corners_world(g, radii) * np.array([-1, 1, 1], np.float32)
    _, quats, _, good = frames_from_octagons(mirrored, radii)
    assert good.all()
    rotations = rotation_matrices(quats)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0, atol=1e-5)
    np.testing.assert_allclose(rotations[:, :, 0] * [-1, 1, 1], -g.rotations[:, :, 0], atol=2e-3)


def test_quaternions_survive_octagons_of_half_turned_gaussians(make_gaussians: Make) -> None:
    g = make_gaussians(100, seed=6)
    g.opacity_logits[:] = 3.0
    g.quats_wxyz[:, 0] = 1e-6
    radii = octagon_radii(g.opacities)
    _, quats, _, good = frames_from_octagons(octagon_corners_world(g, radii), radii)
    assert good.all()
    assert np.abs(np.sum(quats * quaternions_from_matrices(g.rotations), axis=1)).min() > 1 - 1e-6


def test_opacities_of_extreme_logits_do_not_overflow(make_gaussians: Make) -> None:
    g = make_gaussians(4)
    g.opacity_logits[:] = [-1e4, -2.0, 2.0, 1e4]
    sigmoid = 1 / (1 + np.exp(2.0))
    np.testing.assert_allclose(g.opacities, [0, sigmoid, 1 - sigmoid, 1], rtol=1e-6)


def test_select_and_concatenate_are_inverse_and_copy(make_gaussians: Make) -> None:
    g = make_gaussians(10, sh_degree=1)
    both = concatenate([g.select(np.arange(4)), g.select(np.arange(10) >= 4)])
    np.testing.assert_array_equal(both.sh, g.sh)
    np.testing.assert_array_equal(both.quats_wxyz, g.quats_wxyz)
    both.means_world[:] = np.nan
    assert g.is_finite() and not both.is_finite()
