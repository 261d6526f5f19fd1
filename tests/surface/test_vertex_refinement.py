"""What pixels say of where a surface lies, against what is known of planes and of linear maps."""

import numpy as np

from octasplat.engine.geometry.triangle_mesh import unique_edges
from octasplat.engine.surface.kernels.vertex_refinement import (
    apply_jacobian,
    apply_jacobian_transpose,
    jacobian_diagonal,
    linearise,
)

RNG = np.random.default_rng(0)


def rows(*shape: int) -> np.ndarray:
    return RNG.standard_normal(shape).astype(np.float32)


def test_edges_are_unique():
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
    np.testing.assert_array_equal(unique_edges(tetrahedron), [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
    assert unique_edges(tetrahedron[:0]).shape == (0, 2)


def test_vertex_gather_is_transpose_of_scatter():
    corners = RNG.integers(0, 5, (7, 3)).astype(np.int32)
    corners[:, 1:] = (corners[:, :1] + [1, 2]) % 5  # no pixel sees one vertex twice
    weights, lifts, change = rows(7, 3), rows(7, 3), rows(7, 3)
    sure = RNG.random(7).astype(np.float32)

    def pixels_of(values: np.ndarray) -> np.ndarray:
        pixels = np.empty((7, 3), np.float32)
        apply_jacobian(0, len(corners), corners, weights, lifts, change, values, pixels)
        return pixels

    units = np.eye(20, dtype=np.float32).reshape(20, 5, 4)
    matrix = np.stack([pixels_of(unit).reshape(-1) for unit in units], axis=1)
    wanted = rows(7, 3)
    told, squares = np.zeros((5, 4), np.float32), np.zeros((5, 4), np.float32)
    apply_jacobian_transpose(corners, weights, lifts, change, wanted, told)
    np.testing.assert_allclose(told.reshape(-1), matrix.T @ wanted.reshape(-1), atol=1e-5)
    jacobian_diagonal(corners, weights, lifts, change, sure, squares)
    diagonal = (matrix**2 * np.repeat(sure, 3)[:, None]).sum(axis=0)
    np.testing.assert_allclose(squares.reshape(-1), diagonal, rtol=1e-5)


def test_ray_at_raised_plane_sees_neighbouring_color():
    """On z = 0 with color (x, y, 0), raised by h, a ray along d meets (x, y) + h (dx, dy) / dz."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    normals = np.tile(np.float32([0, 0, 1]), (3, 1))
    rgb = vertices * [1, 1, 0]
    corners = np.tile(np.int32([0, 1, 2]), (3, 1))
    weights = np.tile(np.float32([0.5, 0.25, 0.25]), (3, 1))
    ways = np.array([[0.6, 0, -0.8], [0, -0.6, -0.8], [0.999, 0, -0.0447]], np.float32)
    sizes = np.full(3, 0.5, np.float32)
    change, lifts = np.empty((3, 3), np.float32), np.empty((3, 3), np.float32)
    linearise(
        0,
        len(corners),
        vertices,
        normals,
        sizes,
        rgb.astype(np.float32),
        corners,
        weights,
        ways,
        np.ones(3, bool),
        change,
        lifts,
    )
    np.testing.assert_allclose(lifts.sum(axis=1), 0.5)
    # The last looks along the plane and says nothing.
    np.testing.assert_allclose(change, [[-0.75, 0, 0], [0, 0.75, 0], [0, 0, 0]], atol=1e-6)
