"""Shading normals at the corners of triangles."""

import math

import numpy as np
from jaxtyping import Float32, Float64, Int64

from octasplat.engine.core.compilation import kernel


@kernel(error_model="numpy")
def smooth_normals(
    corners: Float64[np.ndarray, "f 3 3"],
    order: Int64[np.ndarray, " c"],
    starts: Int64[np.ndarray, " q1"],
    min_cosine: float,
    normals: Float32[np.ndarray, "f 3 3"],
) -> None:
    """Return the angle-weighted mean normal of the faces around a corner whose normals differ little.

    ``order`` lists corners (3 * face + place) so that those of one point lie together, point q from
    ``starts[q]`` on; ``normals`` (f, 3, 3) gets the result.
    """
    count = len(corners)
    facing, angles = np.empty((count, 3)), np.empty((count, 3))
    for f in range(count):
        for place in range(3):
            a, b, c = corners[f, place], corners[f, (place + 1) % 3], corners[f, (place + 2) % 3]
            u, v = b - a, c - a
            cross = np.cross(u, v)
            # exact also for small angles
            angles[f, place] = math.atan2(math.sqrt((cross * cross).sum()), (u * v).sum())
            if place == 0:
                facing[f] = cross / max(math.sqrt((cross * cross).sum()), 1e-300)
    for q in range(len(starts) - 1):
        for i in range(starts[q], starts[q + 1]):
            own = facing[order[i] // 3]
            x = y = z = 0.0
            for j in range(starts[q], starts[q + 1]):
                f, place = order[j] // 3, order[j] % 3
                other = facing[f]
                if own[0] * other[0] + own[1] * other[1] + own[2] * other[2] >= min_cosine:
                    x += angles[f, place] * other[0]
                    y += angles[f, place] * other[1]
                    z += angles[f, place] * other[2]
            length = math.sqrt(x * x + y * y + z * z)
            normal = normals[order[i] // 3, order[i] % 3]
            if length > 1e-12:
                normal[0], normal[1], normal[2] = x / length, y / length, z / length
            else:  # opposite faces cancel
                normal[0], normal[1], normal[2] = own[0], own[1], own[2]
