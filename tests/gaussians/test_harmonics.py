"""Spherical harmonics turn with their Gaussian."""

import numba
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from octasplat.engine.gaussians.spherical_harmonics import rotate_sh, sh_basis, sh_rotation_matrices
from octasplat.engine.trace.cpu.kernels.spherical_harmonics import eval_sh_basis


@numba.njit
def basis_at(row, x, y, z):
    eval_sh_basis(row, 16, x, y, z)


def directions(count: int, seed: int = 0) -> np.ndarray:
    d = np.random.default_rng(seed).standard_normal((count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_harmonics_basis_equals_tracer() -> None:
    d = directions(50)
    expected = np.zeros((50, 16))
    for row, direction in zip(expected, d, strict=True):
        basis_at(row, *direction)
    np.testing.assert_allclose(sh_basis(d, 3), expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("mirrored", [False, True])
def test_turned_colors_are_the_old_ones_seen_from_turned_directions(degree: int, mirrored: bool) -> None:
    random = np.random.default_rng(degree)
    count = 40
    sh = random.standard_normal((count, (degree + 1) ** 2, 3)).astype(np.float32)
    turns = Rotation.random(count, random_state=degree).as_matrix() * (-1 if mirrored else 1)
    turned = rotate_sh(sh, turns)
    d = directions(30, seed=9)
    new = np.einsum("sk,nkc->nsc", sh_basis(d, degree), turned)
    old = np.einsum("nsk,nkc->nsc", sh_basis(np.einsum("nji,sj->nsi", turns, d), degree), sh)
    np.testing.assert_allclose(new, old, atol=5e-6)


def test_quarter_turn_permutes_first_band() -> None:
    sh = np.zeros((1, 4, 3), np.float32)
    sh[0, 3] = 1.0  # -x
    turned = rotate_sh(sh, np.array([[[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]]))  # x to y
    np.testing.assert_allclose(turned[0, :, 0], [0, 1, 0, 0], atol=1e-7)  # -y


def test_matrices_are_orthogonal_and_follow_one_another() -> None:
    a, b = Rotation.random(2, random_state=1).as_matrix()
    both, first, second = (sh_rotation_matrices(m[None], 3) for m in (b @ a, a, b))
    for band in range(3):
        size = 2 * band + 3
        np.testing.assert_allclose(first[band][0] @ first[band][0].T, np.eye(size), atol=1e-12)
        np.testing.assert_allclose(second[band][0] @ first[band][0], both[band][0], atol=1e-12)


def test_harmonics_identity_rotation_is_exact() -> None:
    sh = np.random.default_rng(0).standard_normal((5, 16, 3)).astype(np.float32)
    np.testing.assert_allclose(rotate_sh(sh, np.broadcast_to(np.eye(3), (5, 3, 3))), sh, atol=1e-6)
