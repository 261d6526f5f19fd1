"""Marching cubes over blocks of voxels; vertices are shared across blocks by the edges they lie on."""

import numpy as np
from numba import prange

from octasplat.engine.core.compilation import device_function, kernel

BLOCK_SIDE = 8
SIDE = BLOCK_SIDE + 1
"""A block's cells also need the first voxels of the next blocks."""
CELLS = SIDE**3


@device_function()
def neighbour(table, blocks, b, x, y, z):
    """Row of the block that holds voxel (x, y, z) counted from block ``b``, and the voxel's place in it."""
    bx, by, bz = (
        blocks[b, 0] + x // BLOCK_SIDE,
        blocks[b, 1] + y // BLOCK_SIDE,
        blocks[b, 2] + z // BLOCK_SIDE,
    )
    place = ((x % BLOCK_SIDE) * BLOCK_SIDE + y % BLOCK_SIDE) * BLOCK_SIDE + z % BLOCK_SIDE
    if bx >= table.shape[0] or by >= table.shape[1] or bz >= table.shape[2]:
        return -1, place
    return table[bx, by, bz], place


@device_function()
def gather_block_values(table, blocks, b, values, weights, min_weight, out):
    """The 9^3 values that the cells of a block need; not-a-number where too little is known."""
    for x in range(SIDE):
        for y in range(SIDE):
            for z in range(SIDE):
                row, place = neighbour(table, blocks, b, x, y, z)
                if row >= 0 and weights[row, place] >= min_weight:
                    out[(x * SIDE + y) * SIDE + z] = values[row, place]
                else:
                    out[(x * SIDE + y) * SIDE + z] = np.nan


@device_function()
def corner_offset(corner):
    """Place of a cell's corner among the 9^3 values, from the cell's first corner."""
    return ((corner & 1) * SIDE + (corner >> 1 & 1)) * SIDE + (corner >> 2 & 1)


@device_function()
def cube_case(near, at):
    """Which corners of the cell lie inside, as bits; 0 where one of them is unknown."""
    case = 0
    for corner in range(8):
        value = near[at + corner_offset(corner)]
        if np.isnan(value):
            return 0
        if value < 0.0:
            case |= 1 << corner
    return case


@kernel(parallel=True)
def count_block_elements(
    table, blocks, values, weights, min_weight, triangle_counts, crossed, vertices, triangles
):
    """How many vertices and triangles each block owns; ``crossed`` gets a bit for each axis of a voxel.

    A voxel owns the edges that leave it along +x, +y and +z. Edges that no cell uses count as well; their
    vertices are dropped later.
    """
    for b in prange(len(blocks)):
        near = np.empty(CELLS, np.float32)
        gather_block_values(table, blocks, b, values, weights, min_weight, near)
        vertex_count, triangle_count = 0, 0
        for x in range(BLOCK_SIDE):
            for y in range(BLOCK_SIDE):
                for z in range(BLOCK_SIDE):
                    at = (x * SIDE + y) * SIDE + z
                    value = near[at]
                    bits = 0
                    if not np.isnan(value):
                        for axis in range(3):
                            other = near[at + corner_offset(1 << axis)]
                            if not np.isnan(other) and (value < 0.0) != (other < 0.0):
                                bits |= 1 << axis
                                vertex_count += 1
                        triangle_count += triangle_counts[cube_case(near, at)]
                    crossed[b, (x * BLOCK_SIDE + y) * BLOCK_SIDE + z] = bits
        vertices[b], triangles[b] = vertex_count, triangle_count


@kernel(parallel=True)
def place_vertices(table, blocks, values, weights, min_weight, crossed, starts, first, points):
    """Vertices where values change sign along edges, in voxels from the grid's first voxel centre.

    ``first`` gets the number of each voxel's first vertex.
    """
    for b in prange(len(blocks)):
        near = np.empty(CELLS, np.float32)
        gather_block_values(table, blocks, b, values, weights, min_weight, near)
        number = starts[b]
        for x in range(BLOCK_SIDE):
            for y in range(BLOCK_SIDE):
                for z in range(BLOCK_SIDE):
                    place = (x * BLOCK_SIDE + y) * BLOCK_SIDE + z
                    first[b, place] = number
                    at = (x * SIDE + y) * SIDE + z
                    for axis in range(3):
                        if crossed[b, place] >> axis & 1:
                            here, there = near[at], near[at + corner_offset(1 << axis)]
                            # Not quite to the ends, where triangles would lose their area.
                            t = min(max(here / (here - there), np.float32(0.01)), np.float32(0.99))
                            points[number, 0] = blocks[b, 0] * BLOCK_SIDE + x
                            points[number, 1] = blocks[b, 1] * BLOCK_SIDE + y
                            points[number, 2] = blocks[b, 2] * BLOCK_SIDE + z
                            points[number, axis] += t
                            number += 1


@kernel(parallel=True)
def place_triangles(
    table, blocks, values, weights, min_weight, edge_corners, edge_table, triangle_counts,
    crossed, first, starts, faces,
):  # fmt: skip
    """Triangles of all cells, in the order of the blocks."""
    for b in prange(len(blocks)):
        near = np.empty(CELLS, np.float32)
        gather_block_values(table, blocks, b, values, weights, min_weight, near)
        number = starts[b]
        for x in range(BLOCK_SIDE):
            for y in range(BLOCK_SIDE):
                for z in range(BLOCK_SIDE):
                    at = (x * SIDE + y) * SIDE + z
                    if np.isnan(near[at]):
                        continue
                    case = cube_case(near, at)
                    for k in range(3 * triangle_counts[case]):
                        edge = edge_table[case, k]
                        low = edge_corners[edge, 0]
                        axis = edge // 4
                        row, place = neighbour(
                            table, blocks, b, x + (low & 1), y + (low >> 1 & 1), z + (low >> 2 & 1)
                        )
                        vertex = first[row, place]
                        for before in range(axis):
                            vertex += crossed[row, place] >> before & 1
                        faces[number + k // 3, k % 3] = vertex
                    number += triangle_counts[case]
