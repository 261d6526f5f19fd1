"""A backdrop sphere around a mesh, which shows the scene wherever the mesh has a gap."""

import numpy as np
from jaxtyping import Float64

from octasplat.engine.geometry.triangle_mesh import TriangleMesh

SPHERE_RINGS = 64
RADIUS_FACTOR = 1.05


def with_backdrop(mesh: TriangleMesh, centre_world: Float64[np.ndarray, "3"]) -> TriangleMesh:
    """Return the mesh with a closed sphere around it that is seen from inside; to be called before coloring.

    Args:
        mesh: without colors.
        centre_world: of the sphere, where the cameras are.
    """
    # beyond the farthest vertex
    radius = RADIUS_FACTOR * float(np.linalg.norm(mesh.vertices_world - centre_world, axis=1).max())
    across = 2 * SPHERE_RINGS
    height = np.pi * np.arange(1, SPHERE_RINGS) / SPHERE_RINGS
    turn = 2 * np.pi * np.arange(across) / across
    rings = np.stack(
        [
            np.outer(np.sin(height), np.cos(turn)),
            np.outer(np.sin(height), np.sin(turn)),
            np.repeat(np.cos(height)[:, None], across, axis=1),
        ],
        axis=-1,
    ).reshape(-1, 3)
    points = np.concatenate([rings, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    here = np.arange(len(rings)).reshape(SPHERE_RINGS - 1, across)
    beside = np.roll(here, -1, axis=1)
    north, south = len(rings), len(rings) + 1
    faces = np.concatenate(
        [
            # wound as seen from inside
            np.stack([here[:-1], beside[:-1], here[1:]], axis=-1).reshape(-1, 3),
            np.stack([beside[:-1], beside[1:], here[1:]], axis=-1).reshape(-1, 3),
            np.stack([np.full(across, north), beside[0], here[0]], axis=-1),
            np.stack([np.full(across, south), here[-1], beside[-1]], axis=-1),
        ]
    )
    placed = (centre_world + radius * points).astype(np.float32)
    return TriangleMesh(
        np.concatenate([mesh.vertices_world, placed]),
        np.concatenate([mesh.faces, (faces + len(mesh.vertices_world)).astype(np.int32)]),
    )
