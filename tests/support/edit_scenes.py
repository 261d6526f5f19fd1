"""What the tests of edits compare with."""

from collections.abc import Callable

import numpy as np

from octasplat.engine.gaussians.legs import legs_world
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.rows import row_arrays

Map = Callable[[np.ndarray], np.ndarray]


def covariances(gaussians: FlatGaussians) -> np.ndarray:
    legs = legs_world(gaussians)
    return legs @ legs.transpose(0, 2, 1)


def covariance_errors(actual: FlatGaussians, expected: np.ndarray) -> np.ndarray:
    """Relative, by Frobenius norm."""
    return np.linalg.norm(covariances(actual) - expected, axis=(1, 2)) / np.linalg.norm(expected, axis=(1, 2))


def assert_same(actual: FlatGaussians, expected: FlatGaussians) -> None:
    wanted = row_arrays(expected)
    for name, array in row_arrays(actual).items():
        np.testing.assert_array_equal(array, wanted[name], err_msg=name)


def random_turn(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    return q * np.sign(np.linalg.det(q))


def twist(angle: float, axis: int = 2) -> tuple[Map, Map]:
    """Turns about an axis by ``angle`` radians a unit along it: the map of points and its derivative."""
    x, y, z = (axis + 1) % 3, (axis + 2) % 3, axis

    def move(points: np.ndarray) -> np.ndarray:
        a = angle * points[..., z]
        moved = points.astype(np.float64)
        moved[..., x] = np.cos(a) * points[..., x] - np.sin(a) * points[..., y]
        moved[..., y] = np.sin(a) * points[..., x] + np.cos(a) * points[..., y]
        return moved

    def derivative(points: np.ndarray) -> np.ndarray:
        a = angle * points[..., z]
        moved = move(points)
        f = np.zeros((*points.shape, 3))
        f[..., x, x] = f[..., y, y] = np.cos(a)
        f[..., x, y], f[..., y, x] = -np.sin(a), np.sin(a)
        f[..., x, z], f[..., y, z] = -angle * moved[..., y], angle * moved[..., x]
        f[..., z, z] = 1.0
        return f

    return move, derivative


def bend(curvature: float) -> tuple[Map, Map]:
    """The plane z = 0 rolled about y onto a cylinder; lengths on it stay."""

    def move(points: np.ndarray) -> np.ndarray:
        a, r = curvature * points[..., 0], 1 / curvature - points[..., 2]
        return np.stack([r * np.sin(a), points[..., 1], 1 / curvature - r * np.cos(a)], axis=-1)

    def derivative(points: np.ndarray) -> np.ndarray:
        a, r = curvature * points[..., 0], 1 / curvature - points[..., 2]
        f = np.zeros((*points.shape, 3))
        f[..., 0, 0], f[..., 0, 2] = curvature * r * np.cos(a), -np.sin(a)
        f[..., 1, 1] = 1.0
        f[..., 2, 0], f[..., 2, 2] = curvature * r * np.sin(a), np.cos(a)
        return f

    return move, derivative


def moved_covariances(gaussians: FlatGaussians, derivative: Map) -> np.ndarray:
    """Covariances under the derivative of a map at the centres."""
    f = derivative(gaussians.means_world.astype(np.float64))
    return f @ covariances(gaussians) @ f.transpose(0, 2, 1)


def grid(cells: int, half: float = 1.2) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a square in the plane z = 0."""
    u = np.linspace(-half, half, cells + 1)
    x, y = np.meshgrid(u, u, indexing="ij")
    i = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    triangles = np.concatenate([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)])
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1), triangles


def cube(cells: int, half: float = 1.2) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and outward triangles of a closed cube."""
    flat, triangles = grid(cells, half)
    points, faces = [], []
    for axis in range(3):
        for side in (1, -1):
            face = np.zeros_like(flat)
            face[:, (axis + 1) % 3], face[:, (axis + 2) % 3], face[:, axis] = (
                flat[:, 0],
                flat[:, 1],
                side * half,
            )
            faces.append((triangles if side > 0 else triangles[:, ::-1]) + len(flat) * len(points))
            points.append(face)
    vertices, numbers = np.unique(np.concatenate(points).round(9), axis=0, return_inverse=True)
    return vertices, numbers.reshape(-1)[np.concatenate(faces)]
