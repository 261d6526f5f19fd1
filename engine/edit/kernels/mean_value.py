"""Mean-value coordinates and winding numbers, for eight points at a time."""

import math

import numpy as np
from jaxtyping import Float64, Int, Int64

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.edit.kernels.mean_value_simd import (
    FLAT_TOLERANCE,
    INVERSE_DISTANCE,
    POINT_ROWS,
    TURN,
    TURN_TOLERANCE,
    VERTEX_ROWS,
    add_means,
    add_means_in_plane,
    add_solid_angle,
    edge_rows,
    edge_rows_wide,
    vertex_rows,
)
from octasplat.engine.trace.cpu.kernels.simd_vector import LANES

POINTS_PER_TASK = 16 * LANES
"""Points that a thread takes at a time."""
ROW_BYTES = LANES * 8
VERTEX_BYTES = VERTEX_ROWS * ROW_BYTES


@device_function(error_model="numpy")
def _gather(
    points: Float64[np.ndarray, "p 3"],
    first: int,
    vertices: Float64[np.ndarray, "v 3"],
    vertex_tolerance: float,
    rows: Float64[np.ndarray, "3 8"],
    offsets: Float64[np.ndarray, "s 8"],
) -> int:
    """Write eight points from ``first`` on, and the vertices as seen from there.

    Where there are fewer than eight, the last one fills the lanes.

    Returns:
        Bits of the lanes of points that are nearer to a vertex than ``vertex_tolerance``.
    """
    for lane in range(LANES):
        i = min(first + lane, len(points) - 1)
        for axis in range(3):
            rows[axis, lane] = points[i, axis]
    near_lanes, points_at, offsets_at = 0, rows.ctypes.data, offsets.ctypes.data
    for j in range(len(vertices)):
        x, y, z = vertices[j, 0], vertices[j, 1], vertices[j, 2]
        vertex_at = np.uintp(offsets_at + j * VERTEX_BYTES)
        near_lanes |= vertex_rows(points_at, x, y, z, vertex_tolerance, vertex_at)
    return near_lanes


@device_function(error_model="numpy")
def _row_addresses(
    base: int, indices: Int[np.ndarray, "t 3"], t: int, row_bytes: int
) -> tuple[np.uintp, np.uintp, np.uintp]:
    """Return the addresses of the three rows ``indices[t]`` of an array that begins at ``base``."""
    return (
        np.uintp(base + indices[t, 0] * row_bytes),
        np.uintp(base + indices[t, 1] * row_bytes),
        np.uintp(base + indices[t, 2] * row_bytes),
    )


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
        for t in range(len(triangles)):
            corners = _row_addresses(offsets.ctypes.data, triangles, t, VERTEX_BYTES)
            add_solid_angle(corners, total.ctypes.data)
        for lane in range(min(LANES, len(points) - first)):
            result[first + lane] = np.int64(np.rint(total[0, lane] / TURN))  # half angles: 2 pi a turn


@kernel(error_model="numpy")
def mean_value_weights(
    first_task: int,
    last_task: int,
    points: Float64[np.ndarray, "p 3"],
    vertices: Float64[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    edges: Int[np.ndarray, "e 2"],
    opposite_edges: Int[np.ndarray, "t 3"],
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
        _weights_block(points, vertices, triangles, edges, opposite_edges, 1e-9 * size, start, weights)


@device_function(error_model="numpy")
def _weights_block(
    points: Float64[np.ndarray, "p 3"],
    vertices: Float64[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    edges: Int[np.ndarray, "e 2"],
    opposite_edges: Int[np.ndarray, "t 3"],
    vertex_tolerance: float,
    start: int,
    weights: Float64[np.ndarray, "p v"],
) -> None:
    """Write the weights of the points of one task, :data:`LANES` of them at a time."""
    count = len(vertices)
    rows = np.empty((POINT_ROWS, LANES))
    # One array for vertices, then edges: numba frees an array whose last use is that of its address, and the
    # vertices' rows are still read below.
    offsets, sums = np.empty((count * VERTEX_ROWS + len(edges), LANES)), np.empty((count, LANES))
    offsets_at, sums_at = offsets.ctypes.data, sums.ctypes.data
    edges_at = offsets_at + count * VERTEX_BYTES
    for first in range(start, min(start + POINTS_PER_TASK, len(points)), LANES):
        # --- unit vectors to the vertices, and the edges' angles over their sines ---
        boundary_lanes = _gather(points, first, vertices, vertex_tolerance, rows, offsets)
        for edge in range(len(edges)):
            a_at = np.uintp(offsets_at + edges[edge, 0] * VERTEX_BYTES)
            b_at = np.uintp(offsets_at + edges[edge, 1] * VERTEX_BYTES)
            edge_at = np.uintp(edges_at + edge * ROW_BYTES)
            if edge_rows(a_at, b_at, edge_at) != 0:  # some lanes see it under an angle that is too wide
                edge_rows_wide(a_at, b_at, edge_at)
        # --- what each triangle adds to the weights of its corners ---
        sums[:] = 0.0
        for t in range(len(triangles)):
            corners = _row_addresses(offsets_at, triangles, t, VERTEX_BYTES)
            triangle_edges = _row_addresses(edges_at, opposite_edges, t, ROW_BYTES)
            corner_sums = _row_addresses(sums_at, triangles, t, ROW_BYTES)
            if add_means(corners, triangle_edges, corner_sums) != 0:
                boundary_lanes |= add_means_in_plane(corners, triangle_edges, corner_sums)
        # --- weights over their sum; the points' places are needed no more ---
        totals = rows[0]
        totals[:] = 0.0
        for j in range(count):
            for lane in range(LANES):
                sums[j, lane] *= offsets[j * VERTEX_ROWS + INVERSE_DISTANCE, lane]
                totals[lane] += sums[j, lane]
        for lane in range(min(LANES, len(points) - first)):
            if (boundary_lanes >> lane) & 1:
                row = weights[first + lane]
                _boundary_coordinates(points[first + lane], vertices, triangles, vertex_tolerance, row)
                continue
            for j in range(count):
                weights[first + lane, j] = sums[j, lane] / totals[lane]


@device_function(error_model="numpy")
def _boundary_coordinates(
    point: Float64[np.ndarray, "3"],
    vertices: Float64[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    vertex_tolerance: float,
    row: Float64[np.ndarray, " v"],
) -> None:
    """Write the mean-value coordinates of a point at a vertex or on a triangle; the first that fits counts.

    On a triangle they are barycentric, from the areas between the point and the edges; all 0 if none fits.
    """
    row[:] = 0.0
    to_corners = np.empty((3, 3))
    lengths, areas = np.empty(3), np.empty(3)
    for j in range(len(vertices)):
        x, y, z = vertices[j, 0] - point[0], vertices[j, 1] - point[1], vertices[j, 2] - point[2]
        if math.sqrt(x * x + y * y + z * z) < vertex_tolerance:
            row[j] = 1.0
            return
    for t in range(len(triangles)):
        for k in range(3):
            for axis in range(3):
                to_corners[k, axis] = vertices[triangles[t, k], axis] - point[axis]
            lengths[k] = math.sqrt(to_corners[k, 0] ** 2 + to_corners[k, 1] ** 2 + to_corners[k, 2] ** 2)
        angle_sum = volume = 0.0
        for k in range(2, -1, -1):  # the volume is the same by each corner; that of corner 0 is kept
            a, b = to_corners[(k + 1) % 3], to_corners[(k + 2) % 3]
            x, y = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2]
            z = a[0] * b[1] - a[1] * b[0]
            areas[k] = math.sqrt(x * x + y * y + z * z)
            angle_sum += math.atan2(areas[k], a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
            volume = x * to_corners[k, 0] + y * to_corners[k, 1] + z * to_corners[k, 2]
        sine = areas[0] / (lengths[1] * lengths[2])
        volume /= lengths[0] * lengths[1] * lengths[2]
        # Twice the tolerances of add_means_in_plane(): rounding here must not miss what it found.
        if abs(volume) <= 2.0 * FLAT_TOLERANCE * sine and angle_sum >= TURN - 2 * TURN_TOLERANCE:
            total = areas[0] + areas[1] + areas[2]
            for k in range(3):
                row[triangles[t, k]] = areas[k] / total
            return
