"""Compiled loops for proxies: triangles near a point, and what follows them."""

import math

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from octasplat.engine.core.compilation import device_function, kernel


@device_function()
def point_triangle_distance(
    point: Float64[np.ndarray, "3"],
    a: Float64[np.ndarray, "3"],
    b: Float64[np.ndarray, "3"],
    c: Float64[np.ndarray, "3"],
) -> float:
    """Return the distance of a point from a triangle.

    The regions are those of "Real-Time Collision Detection" (Ericson 2005), 5.1.5.
    """
    ab0, ab1, ab2 = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    ac0, ac1, ac2 = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    p0, p1, p2 = point[0] - a[0], point[1] - a[1], point[2] - a[2]
    d1 = ab0 * p0 + ab1 * p1 + ab2 * p2
    d2 = ac0 * p0 + ac1 * p1 + ac2 * p2
    v = w = 0.0
    bb = ab0 * ab0 + ab1 * ab1 + ab2 * ab2
    cc = ac0 * ac0 + ac1 * ac1 + ac2 * ac2
    bc = ab0 * ac0 + ab1 * ac1 + ab2 * ac2
    d3, d4 = d1 - bb, d2 - bc
    d5, d6 = d1 - bc, d2 - cc
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        pass  # corner a
    elif d3 >= 0.0 and d4 <= d3:
        v = 1.0  # corner b
    elif d6 >= 0.0 and d5 <= d6:
        w = 1.0  # corner c
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3)  # edge ab
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6)  # edge ac
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))  # edge bc
        v = 1.0 - w
    else:
        total = va + vb + vc
        if total > 0.0:
            v, w = vb / total, vc / total
    x = p0 - v * ab0 - w * ac0
    y = p1 - v * ab1 - w * ac1
    z = p2 - v * ab2 - w * ac2
    return math.sqrt(x * x + y * y + z * z)


@kernel()
def triangle_weights(
    first: int,
    last: int,
    points: Float64[np.ndarray, "p 3"],
    corners: Float64[np.ndarray, "t 3 3"],
    candidates: Int64[np.ndarray, "p k"],
    sample_distances: Float64[np.ndarray, "p k"],
    falloff: float,
    chosen: Int32[np.ndarray, "p k"],
    weights: Float32[np.ndarray, "p k"],
    distances: Float64[np.ndarray, " p"],
) -> None:
    """Write the nearest triangles of each point among ``candidates`` and smooth weights for them.

    The weight falls from 1 at the nearest triangle's distance to 0 at ``falloff`` more, and to 0 at the last
    of the candidates, which came in order of ``sample_distances``; both with zero slope at the end. So it
    changes smoothly as a point moves and as candidates come and go. Unused places have weight 0.
    """
    width = candidates.shape[1]
    for i in range(first, last):
        found = np.empty(width, np.int64)
        far = np.empty(width)
        fade = np.empty(width)
        farthest = max(sample_distances[i, width - 1], 1e-300)
        count = 0
        least = np.inf
        for k in range(width):
            triangle = candidates[i, k]
            known = False
            # Several samples of one triangle may be among the candidates.
            for other in range(count):
                if found[other] == triangle:
                    known = True
                    break
            if known:
                continue
            d = point_triangle_distance(
                points[i], corners[triangle, 0], corners[triangle, 1], corners[triangle, 2]
            )
            found[count] = triangle
            far[count] = d
            share = sample_distances[i, k] / farthest  # the triangle's nearest sample, as they are in order
            fade[count] = (1.0 - share * share) ** 2
            count += 1
            least = min(least, d)
        total = 0.0
        for k in range(count):
            near = max(0.0, 1.0 - (far[k] - least) / falloff)
            fade[k] *= near * near
            total += fade[k]
        if total < 1e-9:  # all are equally near
            for k in range(count):
                fade[k] = 1.0
            total = float(count)
        for k in range(width):
            chosen[i, k] = found[k] if k < count else 0
            weights[i, k] = fade[k] / total if k < count else 0.0
        distances[i] = least


@kernel()
def blend(
    first: int,
    last: int,
    points: Float64[np.ndarray, "p 3"],
    starts: Int64[np.ndarray, " p1"],
    triangles: Int32[np.ndarray, " k"],
    weights: Float32[np.ndarray, " k"],
    derivatives: Float64[np.ndarray, "t 3 3"],
    centres: Float64[np.ndarray, "t 3"],
    moved_centres: Float64[np.ndarray, "t 3"],
    result: Float64[np.ndarray, "p 3"],
) -> None:
    """Write the mean over the triangles t of each point, by their weights, of F_t (x - c_t) + c'_t.

    The triangles of point i stand from ``starts[i]`` to ``starts[i + 1]``; a point without any stays.
    """
    for i in range(first, last):
        x = y = z = total = 0.0
        for k in range(starts[i], starts[i + 1]):
            weight = np.float64(weights[k])
            total += weight
            t = triangles[k]
            d0 = points[i, 0] - centres[t, 0]
            d1 = points[i, 1] - centres[t, 1]
            d2 = points[i, 2] - centres[t, 2]
            f = derivatives[t]
            x += weight * (f[0, 0] * d0 + f[0, 1] * d1 + f[0, 2] * d2 + moved_centres[t, 0])
            y += weight * (f[1, 0] * d0 + f[1, 1] * d1 + f[1, 2] * d2 + moved_centres[t, 1])
            z += weight * (f[2, 0] * d0 + f[2, 1] * d1 + f[2, 2] * d2 + moved_centres[t, 2])
        if total > 0.0:
            result[i, 0], result[i, 1], result[i, 2] = x / total, y / total, z / total
        else:
            result[i, 0], result[i, 1], result[i, 2] = points[i, 0], points[i, 1], points[i, 2]
