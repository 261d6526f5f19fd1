"""The fast mean-value coordinates against the slow ones."""

import numpy as np

from octasplat.engine.edit.proxy import MeanValueBinding, Proxy
from tests.support import mean_value_reference as twin
from tests.support.edit_scenes import cube


def dented_ball(cells: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed cage that is neither convex nor alike on two sides."""
    vertices, triangles = cube(cells)
    directions = vertices / np.linalg.norm(vertices, axis=1, keepdims=True)
    return directions * (1.2 - 0.7 * np.exp(-6 * (1 - directions @ [0.6, 0.0, 0.8])))[:, None], triangles


def test_mean_value_coordinates_match_reference() -> None:
    """Inside, outside, at vertices, on edges, on faces, in their planes and a hair off them."""
    vertices, triangles = dented_ball(3)
    proxy = Proxy(vertices, triangles)
    random = np.random.default_rng(0)
    on_faces = vertices[triangles[:6]].mean(axis=1)
    points = np.concatenate(
        [
            random.uniform(-1.3, 1.3, (60, 3)),
            vertices[:5],
            vertices[triangles[:5, :2]].mean(axis=1),
            on_faces,
            on_faces * (1 + 1e-7),
            on_faces * (1 - 1e-7),
            on_faces + 2 * (vertices[triangles[:6, 1]] - vertices[triangles[:6, 0]]),
        ]
    )
    moves = random.standard_normal((5, *vertices.shape))
    binding = MeanValueBinding(proxy, points[:, None].repeat(8, axis=1), reach_world=np.inf)
    slow = np.array(
        [twin.reference_coordinates(p, vertices, proxy.triangles, proxy.diagonal) for p in points]
    )
    for shifts in moves:
        moved = binding.deform(vertices + shifts)
        np.testing.assert_allclose(moved, (points + slow @ shifts)[:, None].repeat(8, axis=1), atol=1e-11)


def test_winding_numbers_match_reference() -> None:
    vertices, triangles = dented_ball(3)
    twice = np.concatenate([triangles, triangles + len(vertices)])
    proxy = Proxy(np.concatenate([vertices, 0.5 * vertices + [0.3, 0.0, 0.0]]), twice)
    points = np.random.default_rng(1).uniform(-1.3, 1.3, (400, 3))
    expected = twin.reference_winding_numbers(points, proxy.vertices_world, proxy.triangles)
    assert set(expected) == {0, 1, 2}
    inside = MeanValueBinding(proxy, points[:, None].repeat(8, axis=1), None).moving_mask
    np.testing.assert_array_equal(inside, expected != 0)
