"""Scenes moved as a whole, cut and put together."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.edit.selection import in_box, in_sphere
from octasplat.engine.gaussians import affine
from octasplat.engine.gaussians.merge import merge_scenes, with_sh_degree
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.spherical_harmonics import sh_basis
from tests.support.edit_scenes import assert_same, covariance_errors, covariances, random_turn

Make = Callable[..., FlatGaussians]


def matrix_of(linear: np.ndarray, shift: tuple[float, ...] = (0.5, -1.0, 2.0)) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, shift
    return matrix


@pytest.mark.parametrize(
    "linear",
    [
        random_turn(1),
        2.5 * random_turn(2),
        random_turn(3) * [1, 1, -1],
        np.diag([1.0, 2.0, 0.5]),
        np.array([[1.2, 0.3, 0.0], [0.0, 0.8, 0.1], [0.2, 0.0, 1.0]]),
    ],
    ids=["rotation", "similarity", "mirror", "stretch", "shear"],
)
def test_centres_and_covariances_follow_every_affine_map(make_scene: Make, linear: np.ndarray) -> None:
    g = make_scene(200)
    g.log_scales[:20, 1] = -25.0  # needles
    result = affine.transform_gaussians(g, matrix_of(linear))
    np.testing.assert_allclose(result.means_world, g.means_world @ linear.T + [0.5, -1, 2], atol=1e-6)
    assert covariance_errors(result, linear @ covariances(g) @ linear.T).max() < 2e-6
    np.testing.assert_array_equal(result.opacity_logits, g.opacity_logits)
    u, _, vt = np.linalg.svd(linear)
    d = random_turn(9)
    seen = np.einsum("sk,nkc->nsc", sh_basis(d @ (u @ vt).T, 3), result.sh)
    np.testing.assert_allclose(seen, np.einsum("sk,nkc->nsc", sh_basis(d, 3), g.sh), atol=1e-5)


def test_transform_inverse_restores_scene(make_scene: Make) -> None:
    g = make_scene(200)
    matrix = matrix_of(3.0 * random_turn(5))
    back = affine.transform_gaussians(affine.transform_gaussians(g, matrix), np.linalg.inv(matrix))
    np.testing.assert_allclose(back.means_world, g.means_world, atol=1e-6)
    assert covariance_errors(back, covariances(g)).max() < 5e-6
    np.testing.assert_allclose(back.sh, g.sh, atol=1e-5)


def test_translation_changes_centres_only(make_scene: Make) -> None:
    g = make_scene(50)
    result = affine.transform_gaussians(g, affine.translation(np.array([1.0, 2.0, 3.0])))
    np.testing.assert_array_equal(
        result.means_world, (g.means_world.astype(np.float64) + np.array([1, 2, 3])).astype("f4")
    )
    result.means_world = g.means_world
    assert_same(result, g)


def test_rotation_and_scale_matrices_match_known_values() -> None:
    np.testing.assert_array_equal(affine.rotation(np.array([0, 0, 2.0]), 90)[:3, :3] @ [1, 0, 0], [0, 1, 0])
    np.testing.assert_allclose(
        affine.rotation(np.array([0, 0, 1.0]), -30)[:3, 0], [np.sqrt(0.75), -0.5, 0], atol=1e-15
    )
    np.testing.assert_array_equal(
        affine.conjugate_by_point(affine.scaling(np.full(3, 2.0)), np.ones(3)) @ [1, 1, 2, 1], [1, 1, 3, 1]
    )
    for old in affine.AXES:
        for new in affine.AXES:
            turn = affine.between_axes(old, new)[:3, :3]
            np.testing.assert_allclose(turn @ affine.AXES[old], affine.AXES[new], atol=1e-15)
            assert np.linalg.det(turn) == pytest.approx(1.0)


@pytest.mark.parametrize(
    "linear", [np.zeros((3, 3)), np.diag([1.0, 1.0, 0.0]), np.full((3, 3), np.nan)], ids=str
)
def test_singular_map_is_refused(make_scene: Make, linear: np.ndarray) -> None:
    with pytest.raises(ConfigError):
        affine.transform_gaussians(make_scene(3), matrix_of(linear))


def test_matrix_file_is_parsed(tmp_path: Path) -> None:
    path = tmp_path / "matrix.txt"
    path.write_text("[[1, 0, 0, 4],\n [0, 1, 0, 5],\n [0, 0, 1, 6]]\n")
    np.testing.assert_array_equal(affine.read_matrix(path), affine.translation(np.array([4.0, 5, 6])))
    for text, message in (("1 2 3", "holds 3 numbers"), ("a b", "holds no matrix")):
        path.write_text(text)
        with pytest.raises(ConfigError, match=message):
            affine.read_matrix(path)
    with pytest.raises(ConfigError, match=r"none\.txt"):
        affine.read_matrix(tmp_path / "none.txt")


def test_box_and_sphere_masks_include_boundary(make_scene: Make) -> None:
    g = make_scene(4)
    g.means_world[:] = [[0, 0, 0], [1, 1, 1], [1, 1, 1.01], [-0.5, 0, 0]]
    np.testing.assert_array_equal(in_box(g, np.zeros(3), np.ones(3)), [True, True, False, False])
    np.testing.assert_array_equal(in_sphere(g, np.array([0, 0, 0.0]), 0.5), [True, False, False, True])
    with pytest.raises(ConfigError, match="smallest"):
        in_box(g, np.ones(3), np.zeros(3))
    with pytest.raises(ConfigError, match="positive"):
        in_sphere(g, np.zeros(3), 0.0)


def test_merging_harmonises_the_harmonics(make_scene: Make) -> None:
    plain, shiny = make_scene(5, sh_degree=0), make_scene(7, sh_degree=2, seed=1)
    both = merge_scenes([plain, shiny])
    assert both.sh_degree == 2 and len(both) == 12
    assert_same(both.select(np.arange(5, 12)), shiny)
    np.testing.assert_array_equal(both.sh[:5, 0], plain.sh[:, 0])
    assert not both.sh[:5, 1:].any()
    assert_same(with_sh_degree(both.select(np.arange(5)), 0), plain)
    assert merge_scenes([plain, shiny], sh_degree=1).sh_degree == 1
