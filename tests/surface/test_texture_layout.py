"""Surfaces cut open for a texture: few pieces, each place once, about as large as it is."""

import numpy as np
import pytest
import trimesh

from octasplat.engine.geometry.triangle_mesh import TriangleMesh
from octasplat.engine.surface.mesh_cleanup import face_components
from octasplat.engine.surface.texture import unwrap

SIDE = 512


@pytest.mark.parametrize("roughness", [0.0, 0.02, 0.04])
def test_rough_ball_has_few_charts(roughness: float) -> None:
    """Creases of up to 68 degrees between triangles in the median, as noise of half an edge makes them."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    random = np.random.default_rng(0)
    vertices = ball.vertices + roughness * random.standard_normal(ball.vertices.shape)
    layout = unwrap(TriangleMesh(vertices.astype(np.float32), ball.faces.astype(np.int32)), SIDE)
    mesh = layout.mesh
    piece = face_components(mesh)
    assert piece.max() < 20
    assert len(mesh.vertices_world) < 1.25 * len(vertices)
    np.testing.assert_array_equal(mesh.face_corners_world, vertices.astype(np.float32)[ball.faces])
    flat = mesh.uv[mesh.faces].astype(np.float64) * SIDE
    (ax, ay), (bx, by) = (flat[:, 1] - flat[:, 0]).T, (flat[:, 2] - flat[:, 0]).T
    areas_px = 0.5 * (ax * by - ay * bx)
    # No triangle lies upon another: none is turned over in its piece, and together they fill the pixels.
    np.testing.assert_array_equal(np.abs(np.bincount(piece, np.sign(areas_px))), np.bincount(piece))
    filled = np.abs(areas_px).sum()
    assert filled > 0.3 * SIDE**2
    assert filled == pytest.approx(len(layout.rows), rel=0.15)
