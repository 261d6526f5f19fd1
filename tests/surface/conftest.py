"""Scenes and meshes whose surfaces are known."""

import numpy as np
import pytest

from octasplat.engine.gaussians.frames import frames_from_normals, quaternions_from_matrices
from octasplat.engine.gaussians.model import SH_C0, FlatGaussians
from octasplat.engine.geometry.triangle_mesh import TriangleMesh


@pytest.fixture(scope="session")
def ball() -> FlatGaussians:
    """A ball of radius 1 at the origin, tiled with flat Gaussians; red above z = 0, blue below."""
    count = 3000
    order = np.arange(count)
    height, angle = 1 - (2 * order + 1) / count, order * 2.399963229728653
    across = np.sqrt(1 - height**2)
    normals = np.stack([across * np.cos(angle), across * np.sin(angle), height], axis=1)
    scale = np.sqrt(4 * np.pi / count)
    rgb = np.where(height[:, None] > 0, [0.9, 0.1, 0.1], [0.1, 0.1, 0.9])
    return FlatGaussians(
        normals.astype(np.float32),
        quaternions_from_matrices(frames_from_normals(normals)).astype(np.float32),
        np.full((count, 2), np.log(scale), np.float32),
        np.full(count, 6.0, np.float32),
        ((rgb - 0.5) / SH_C0).astype(np.float32)[:, None],
    )


@pytest.fixture
def sheet() -> TriangleMesh:
    """A flat square of 20 x 20 cells with side 1 in the plane z = 0, seen from above."""
    size = 21
    y, x = np.mgrid[0:size, 0:size] / 20.0
    vertices = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).reshape(-1)
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + size + 1], 1),
            np.stack([corner, corner + size + 1, corner + size], 1),
        ]
    )
    return TriangleMesh(vertices, faces.astype(np.int32))
