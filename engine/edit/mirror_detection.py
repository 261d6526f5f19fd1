"""Detection of mirrored proxies: the moved vertices alone do not say which side of a surface is which."""

import numpy as np
from jaxtyping import Float64, Int64

MIN_VOLUME = 1e-6
"""Of the diagonal cubed: below it a closed mesh is too flat to have an inside."""
MIN_DEPTH = 1e-2
"""Of the largest extent: flatter open meshes look the same mirrored and turned over."""
AFFINE_RESIDUAL = 1e-3
"""Of the largest extent: open meshes further than this from an affine image were bent, not mirrored."""


def was_mirrored(
    rest_world: Float64[np.ndarray, "v 3"],
    moved_world: Float64[np.ndarray, "v 3"],
    triangles: Int64[np.ndarray, "t 3"],
    closed: bool,
) -> bool:
    """Return whether the deformation of a mesh mirrors the space around it.

    A closed mesh was mirrored if its inside came out: the signed volume changed its sign. An open one can be
    pushed through itself like a bowl, which mirrors nothing; it counts as mirrored only where one affine map
    with a negative determinant moves all of it. A plane is never mirrored, as turning it over does the same.

    Args:
        rest_world: vertices at rest.
        moved_world: the same vertices, moved.
        triangles: vertex indices.
        closed: whether every edge has two triangles.
    """
    if closed:
        volumes = []
        for vertices in (rest_world, moved_world):
            size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
            volume = signed_volume(vertices, triangles)
            volumes.append(volume if abs(volume) > MIN_VOLUME * size**3 else 0.0)
        return volumes[0] * volumes[1] < 0.0
    used = np.unique(triangles)
    rest = rest_world[used] - rest_world[used].mean(axis=0)
    moved = moved_world[used] - moved_world[used].mean(axis=0)
    _, extents, _ = np.linalg.svd(rest, full_matrices=False)
    if len(extents) < 3 or extents[2] <= MIN_DEPTH * extents[0]:
        return False
    linear = np.linalg.lstsq(rest, moved, rcond=None)[0]
    off = np.abs(rest @ linear - moved).max()
    if off > AFFINE_RESIDUAL * np.abs(moved).max():
        return False
    return bool(np.linalg.det(linear) < 0.0)


def signed_volume(vertices_world: Float64[np.ndarray, "v 3"], triangles: Int64[np.ndarray, "t 3"]) -> float:
    """Return the volume inside a closed mesh, cubic world units; negative if its triangles face inwards."""
    # About the mean: far from the origin, large terms would cancel.
    a, b, c = (vertices_world - vertices_world.mean(axis=0))[triangles].transpose(1, 0, 2)
    return float(np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0)
