"""Compiled loops for proxies: triangles near a point, and mean-value coordinates."""

import math

import numpy as np
from numba import njit, prange


@njit(cache=True)
def point_triangle_distance(point, a, b, c):
    """Distance of a point from a triangle (the regions of Ericson, Real-Time Collision Detection, 5.1.5)."""
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
        pass
    elif d3 >= 0.0 and d4 <= d3:
        v = 1.0
    elif d6 >= 0.0 and d5 <= d6:
        w = 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3)
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1.0 - w
    else:
        total = va + vb + vc
        if total > 0.0:
            v, w = vb / total, vc / total
    x = p0 - v * ab0 - w * ac0
    y = p1 - v * ab1 - w * ac1
    z = p2 - v * ab2 - w * ac2
    return math.sqrt(x * x + y * y + z * z)


@njit(cache=True, parallel=True)
def triangle_weights(points, corners, candidates, sample_distances, falloff, chosen, weights, distances):
    """Nearest triangles of each point among ``candidates`` and smooth weights for them.

    The weight falls from 1 at the nearest triangle's distance to 0 at ``falloff`` more, and to 0 at the last
    of the candidates, which came in order of ``sample_distances``; both with zero slope at the end. So it
    changes smoothly as a point moves and as candidates come and go. Unused places have weight 0.
    """
    width = candidates.shape[1]
    for i in prange(points.shape[0]):
        found = np.empty(width, np.int64)
        far = np.empty(width)
        fade = np.empty(width)
        last = max(sample_distances[i, width - 1], 1e-300)
        count = 0
        least = np.inf
        for k in range(width):
            triangle = candidates[i, k]
            known = False
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
            share = sample_distances[i, k] / last  # the triangle's nearest sample, as they are in order
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


@njit(cache=True, parallel=True)
def blend(points, starts, triangles, weights, derivatives, centres, moved_centres, result):
    """Result = mean over the triangles t of each point, by their weights, of F_t (x - c_t) + c'_t.

    The triangles of point i stand from ``starts[i]`` to ``starts[i + 1]``; a point without any stays.
    """
    for i in prange(points.shape[0]):
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


@njit(cache=True, parallel=True)
def winding_numbers(points, vertices, triangles, result):
    """How often a closed mesh winds round each point: the sum of its triangles' solid angles over 4 pi."""
    count = vertices.shape[0]
    for i in prange(points.shape[0]):
        unit = np.empty((count, 3))
        for j in range(count):
            x = vertices[j, 0] - points[i, 0]
            y = vertices[j, 1] - points[i, 1]
            z = vertices[j, 2] - points[i, 2]
            d = max(math.sqrt(x * x + y * y + z * z), 1e-300)
            unit[j, 0], unit[j, 1], unit[j, 2] = x / d, y / d, z / d
        solid = 0.0
        for t in range(triangles.shape[0]):
            a, b, c = unit[triangles[t, 0]], unit[triangles[t, 1]], unit[triangles[t, 2]]
            determinant = (
                a[0] * (b[1] * c[2] - b[2] * c[1])
                - a[1] * (b[0] * c[2] - b[2] * c[0])
                + a[2] * (b[0] * c[1] - b[1] * c[0])
            )
            dots = (
                1.0
                + (a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
                + (b[0] * c[0] + b[1] * c[1] + b[2] * c[2])
                + (c[0] * a[0] + c[1] * a[1] + c[2] * a[2])
            )
            solid += 2.0 * math.atan2(determinant, dots)
        result[i] = np.int64(np.rint(solid / (4.0 * math.pi)))


@njit(cache=True, parallel=True)
def mean_value_weights(points, vertices, triangles, size, weights):
    """Mean-value coordinates of points in a closed triangle mesh (Ju, Schaefer, Warren 2005).

    The weights of a triangle are the components of its mean vector, half the sum of its angles times the unit
    normals of the three planes through the point and an edge, along the directions of its corners. ``size``
    is a length of the mesh, against which nearness is judged.
    """
    count = vertices.shape[0]
    near = 1e-9 * size
    for i in prange(points.shape[0]):
        unit = np.empty((count, 3))
        length = np.empty(count)
        cross = np.empty((3, 3))
        theta = np.empty(3)
        row = weights[i]
        row[:] = 0.0
        settled = False
        for j in range(count):
            x = vertices[j, 0] - points[i, 0]
            y = vertices[j, 1] - points[i, 1]
            z = vertices[j, 2] - points[i, 2]
            d = math.sqrt(x * x + y * y + z * z)
            length[j] = d
            if d < near:
                row[j] = 1.0
                settled = True
                break
            unit[j, 0], unit[j, 1], unit[j, 2] = x / d, y / d, z / d
        if settled:
            continue
        for t in range(triangles.shape[0]):
            m0 = m1 = m2 = 0.0
            for k in range(3):
                a = unit[triangles[t, (k + 1) % 3]]
                b = unit[triangles[t, (k + 2) % 3]]
                x = a[1] * b[2] - a[2] * b[1]
                y = a[2] * b[0] - a[0] * b[2]
                z = a[0] * b[1] - a[1] * b[0]
                sine = math.sqrt(x * x + y * y + z * z)
                theta[k] = math.atan2(sine, a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
                cross[k, 0], cross[k, 1], cross[k, 2] = x, y, z
                share = 0.5 * theta[k] / max(sine, 1e-300)
                m0 += share * x
                m1 += share * y
                m2 += share * z
            first = unit[triangles[t, 0]]
            sine = math.sqrt(cross[0, 0] ** 2 + cross[0, 1] ** 2 + cross[0, 2] ** 2)
            determinant = first[0] * cross[0, 0] + first[1] * cross[0, 1] + first[2] * cross[0, 2]
            if abs(determinant) <= 1e-9 * sine:  # the point lies in the triangle's plane
                if theta[0] + theta[1] + theta[2] < 2.0 * math.pi - 1e-6:
                    continue  # outside of it, where its weights are 0
                row[:] = 0.0
                total = 0.0
                for k in range(3):
                    a, b = triangles[t, (k + 1) % 3], triangles[t, (k + 2) % 3]
                    area = math.sin(theta[k]) * length[a] * length[b]
                    row[triangles[t, k]] = area
                    total += area
                for k in range(3):
                    row[triangles[t, k]] /= total
                settled = True
                break
            for k in range(3):
                vertex = triangles[t, k]
                component = m0 * cross[k, 0] + m1 * cross[k, 1] + m2 * cross[k, 2]
                row[vertex] += component / (determinant * length[vertex])
        if settled:
            continue
        total = 0.0
        for j in range(count):
            total += row[j]
        for j in range(count):
            row[j] /= total
