"""Mean-value coordinates and winding numbers, for eight points at a time."""

import math

import numpy as np
from jaxtyping import Float64, Int, Int64

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.edit.kernels.mean_value_simd import (
    FLAT_TOLERANCE,
    POINT_ROWS,
    TURN,
    VERTEX_ROWS,
    add_flat_means,
    add_means,
    add_solid_angle,
    edge_rows,
    edge_rows_wide,
    vertex_rows,
)
from octasplat.engine.trace.cpu.kernels.simd_vector import LANES

POINTS_PER_TASK = 16 * LANES
"""Points that a thread takes at a time."""


@device_function(error_model="numpy")
def _gather(
    points: Float64[np.ndarray, "p 3"],
    first: int,
    vertices: Float64[np.ndarray, "v 3"],
    near: float,
    rows: Float64[np.ndarray, "3 8"],
    offsets: Float64[np.ndarray, "s 8"],
) -> int:
    """Eight points from ``first`` on (the last one again where there are fewer), and the vertices from there.

    Returns the bits of points that are nearer to a vertex than ``near``.
    """
    for lane in range(LANES):
        i = min(first + lane, len(points) - 1)
        for axis in range(3):
            rows[axis, lane] = points[i, axis]
    met, place, at = 0, rows.ctypes.data, offsets.ctypes.data
    for j in range(len(vertices)):
        row = np.uintp(at + j * VERTEX_ROWS * LANES * 8)
        met |= vertex_rows(place, vertices[j, 0], vertices[j, 1], vertices[j, 2], near, row)
    return met


@kernel(error_model="numpy")
def winding_numbers(
    first_task: int,
    last_task: int,
    points: Float64[np.ndarray, "p 3"],
    vertices: Float64[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    result: Int64[np.ndarray, " p"],
) -> None:
    """Write how often a closed mesh winds round each point: its triangles' solid angles over 4 pi.

    A task has :data:`POINTS_PER_TASK` points.
    """
    for chunk in range(first_task, last_task):
        _winding_block(points, vertices, triangles, chunk * POINTS_PER_TASK, result)


@device_function(error_model="numpy")
def _winding_block(
    points: Float64[np.ndarray, "p 3"],
    vertices: Float64[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    start: int,
    result: Int64[np.ndarray, " p"],
) -> None:
    rows, total = np.empty((POINT_ROWS, LANES)), np.empty((1, LANES))
    offsets = np.empty((len(vertices) * VERTEX_ROWS, LANES))
    for first in range(start, min(start + POINTS_PER_TASK, len(points)), LANES):
        _gather(points, first, vertices, 0.0, rows, offsets)
        total[:] = 0.0
        at, step = offsets.ctypes.data, VERTEX_ROWS * LANES * 8
        for t in range(len(triangles)):
            a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
            add_solid_angle(
                (np.uintp(at + a * step), np.uintp(at + b * step), np.uintp(at + c * step)), total.ctypes.data
            )
        for lane in range(min(LANES, len(points) - first)):
            result[first + lane] = np.int64(np.rint(total[0, lane] / TURN))


@kernel(error_model="numpy")
def mean_value_weights(
    first_task: int,
    last_task: int,
    points: Float64[np.ndarray, "p 3"],
    vertices: Float64[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    edges: Int[np.ndarray, "e 2"],
    opposite: Int[np.ndarray, "t 3"],
    size: float,
    weights: Float64[np.ndarray, "p v"],
) -> None:
    """Write mean-value coordinates of points in a closed triangle mesh (Ju, Schaefer, Warren 2005).

    The weights of a triangle are the components of its mean vector, half the sum of its angles times the unit
    normals of the three planes through the point and an edge, along the directions of its corners. ``size``
    is a length of the mesh, against which nearness is judged. ``opposite`` names the edge opposite of each
    corner of each triangle.
    """
    for chunk in range(first_task, last_task):
        start = chunk * POINTS_PER_TASK
        _weights_block(points, vertices, triangles, edges, opposite, 1e-9 * size, start, weights)


@device_function(error_model="numpy")
def _weights_block(
    points: Float64[np.ndarray, "p 3"],
    vertices: Float64[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    edges: Int[np.ndarray, "e 2"],
    opposite: Int[np.ndarray, "t 3"],
    near: float,
    start: int,
    weights: Float64[np.ndarray, "p v"],
) -> None:
    count = len(vertices)
    rows = np.empty((POINT_ROWS, LANES))
    # Of vertices, then of edges; one array, as numba frees what only its address is used of.
    offsets, sums = np.empty((count * VERTEX_ROWS + len(edges), LANES)), np.empty((count, LANES))
    row, step = LANES * 8, VERTEX_ROWS * LANES * 8
    at, counted = offsets.ctypes.data, sums.ctypes.data
    beside = at + count * step
    for first in range(start, min(start + POINTS_PER_TASK, len(points)), LANES):
        special = _gather(points, first, vertices, near, rows, offsets)
        for e in range(len(edges)):
            a, b = np.uintp(at + edges[e, 0] * step), np.uintp(at + edges[e, 1] * step)
            if edge_rows(a, b, np.uintp(beside + e * row)) != 0:
                edge_rows_wide(a, b, np.uintp(beside + e * row))
        sums[:] = 0.0
        for t in range(len(triangles)):
            a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
            d, e, f = opposite[t, 0], opposite[t, 1], opposite[t, 2]
            corners = np.uintp(at + a * step), np.uintp(at + b * step), np.uintp(at + c * step)
            sides = np.uintp(beside + d * row), np.uintp(beside + e * row), np.uintp(beside + f * row)
            into = np.uintp(counted + a * row), np.uintp(counted + b * row), np.uintp(counted + c * row)
            if add_means(corners, sides, into) != 0:
                special |= add_flat_means(corners, sides, into)
        totals = rows[0]
        totals[:] = 0.0
        for j in range(count):
            for lane in range(LANES):
                sums[j, lane] *= offsets[j * VERTEX_ROWS + 3, lane]
                totals[lane] += sums[j, lane]
        for lane in range(min(LANES, len(points) - first)):
            if (special >> lane) & 1:
                _boundary_coordinates(points[first + lane], vertices, triangles, near, weights[first + lane])
                continue
            for j in range(count):
                weights[first + lane, j] = sums[j, lane] / totals[lane]


@device_function(error_model="numpy")
def _boundary_coordinates(
    point: Float64[np.ndarray, "3"],
    vertices: Float64[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    near: float,
    row: Float64[np.ndarray, " v"],
) -> None:
    """Write the coordinates of a point that is one of the vertices, or else lies on a triangle.

    The first one's.
    """
    row[:] = 0.0
    way = np.empty((3, 3))
    lengths, areas = np.empty(3), np.empty(3)
    for j in range(len(vertices)):
        x, y, z = vertices[j, 0] - point[0], vertices[j, 1] - point[1], vertices[j, 2] - point[2]
        if math.sqrt(x * x + y * y + z * z) < near:
            row[j] = 1.0
            return
    for t in range(len(triangles)):
        for k in range(3):
            for axis in range(3):
                way[k, axis] = vertices[triangles[t, k], axis] - point[axis]
            lengths[k] = math.sqrt(way[k, 0] ** 2 + way[k, 1] ** 2 + way[k, 2] ** 2)
        around = volume = 0.0
        for k in range(2, -1, -1):
            a, b = way[(k + 1) % 3], way[(k + 2) % 3]
            x, y = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2]
            z = a[0] * b[1] - a[1] * b[0]
            areas[k] = math.sqrt(x * x + y * y + z * z)
            around += math.atan2(areas[k], a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
            volume = x * way[k, 0] + y * way[k, 1] + z * way[k, 2]
        sine = areas[0] / (lengths[1] * lengths[2])
        volume /= lengths[0] * lengths[1] * lengths[2]
        if abs(volume) <= 2.0 * FLAT_TOLERANCE * sine and around >= TURN - 2e-6:
            total = areas[0] + areas[1] + areas[2]
            for k in range(3):
                row[triangles[t, k]] = areas[k] / total
            return
