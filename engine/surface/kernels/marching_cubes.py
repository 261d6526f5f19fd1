"""Marching cubes over blocks of voxels; vertices are shared across blocks by the edges they lie on.

"Marching Cubes: A High Resolution 3D Surface Construction Algorithm" (Lorensen and Cline 1987). Elements are
counted first, so that each block knows where its own go; then vertices are placed, then triangles.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int8, Int32, Int64, UInt8

from octasplat.engine.core.compilation import device_function, kernel

BLOCK_SIDE = 8
SIDE = BLOCK_SIDE + 1
"""A block's cells also need the first voxels of the next blocks."""
CELLS = SIDE**3
BLOCK_VOXELS = BLOCK_SIDE**3


class VolumeArrays(NamedTuple):
    """A sparse volume of signed distances.

    Attributes:
        table: row of each block of the grid in the other arrays, -1 for none.
        blocks: place of each block in the grid.
        values: signed distances, positive in front of the surface.
        weights: how sure they are.
        min_weight: below which they count for nothing.
    """

    table: Int32[np.ndarray, "bx by bz"]
    blocks: Int32[np.ndarray, "b 3"]
    values: Float32[np.ndarray, "b 512"]
    weights: Float32[np.ndarray, "b 512"]
    min_weight: float


@device_function()
def neighbour(
    table: Int32[np.ndarray, "bx by bz"], blocks: Int32[np.ndarray, "b 3"], b: int, x: int, y: int, z: int
) -> tuple[int, int]:
    """Return the block row that holds voxel (x, y, z) counted from block ``b``, and its place there."""
    bx, by, bz = (
        blocks[b, 0] + x // BLOCK_SIDE,
        blocks[b, 1] + y // BLOCK_SIDE,
        blocks[b, 2] + z // BLOCK_SIDE,
    )
    place = ((x % BLOCK_SIDE) * BLOCK_SIDE + y % BLOCK_SIDE) * BLOCK_SIDE + z % BLOCK_SIDE
    # only upwards: cells reach to the next block, never to the one before
    if bx >= table.shape[0] or by >= table.shape[1] or bz >= table.shape[2]:
        return -1, place
    return table[bx, by, bz], place


@device_function()
def block_values(volume: VolumeArrays, b: int) -> Float32[np.ndarray, "729"]:
    """Return the 9^3 values that the cells of a block need; not-a-number where too little is known."""
    out = np.empty(CELLS, np.float32)
    for x in range(SIDE):
        for y in range(SIDE):
            for z in range(SIDE):
                row, place = neighbour(volume.table, volume.blocks, b, x, y, z)
                if row >= 0 and volume.weights[row, place] >= volume.min_weight:
                    out[(x * SIDE + y) * SIDE + z] = volume.values[row, place]
                else:
                    out[(x * SIDE + y) * SIDE + z] = np.nan
    return out


@device_function()
def voxel_place(voxel: int) -> tuple[int, int, int, int]:
    """Return x, y and z of a block's voxel, and its place among the 9^3 values."""
    x, y, z = voxel // (BLOCK_SIDE * BLOCK_SIDE), voxel // BLOCK_SIDE % BLOCK_SIDE, voxel % BLOCK_SIDE
    return x, y, z, (x * SIDE + y) * SIDE + z


@device_function()
def corner_offset(corner: int) -> int:
    """Return the place of a cell's corner among the 9^3 values, from the cell's first corner."""
    return ((corner & 1) * SIDE + (corner >> 1 & 1)) * SIDE + (corner >> 2 & 1)


@device_function()
def cube_case(near: Float32[np.ndarray, "729"], at: int) -> int:
    """Return which corners of the cell lie inside, as bits; 0 where one of them is unknown."""
    case = 0
    for corner in range(8):
        value = near[at + corner_offset(corner)]
        if np.isnan(value):
            return 0  # no surface where something is unknown
        if value < 0.0:
            case |= 1 << corner
    return case


@kernel()
def count_block_elements(
    first_block: int,
    last_block: int,
    volume: VolumeArrays,
    triangle_counts: Int32[np.ndarray, "256"],
    crossed: UInt8[np.ndarray, "b 512"],
    vertices: Int64[np.ndarray, " b"],
    triangles: Int64[np.ndarray, " b"],
) -> None:
    """Count the vertices and triangles of each of the blocks ``first_block`` to ``last_block``.

    ``crossed`` gets a bit for each axis of a voxel whose edge the surface crosses. A voxel owns the edges
    that leave it along +x, +y and +z. Edges that no cell uses count as well; their vertices are dropped
    later.
    """
    for b in range(first_block, last_block):
        near = block_values(volume, b)
        vertex_count, triangle_count = 0, 0
        for voxel in range(BLOCK_VOXELS):
            _, _, _, at = voxel_place(voxel)
            value = near[at]
            bits = 0
            if not np.isnan(value):
                for axis in range(3):
                    other = near[at + corner_offset(1 << axis)]
                    if not np.isnan(other) and (value < 0.0) != (other < 0.0):
                        bits |= 1 << axis
                        vertex_count += 1
                triangle_count += triangle_counts[cube_case(near, at)]
            crossed[b, voxel] = bits
        vertices[b], triangles[b] = vertex_count, triangle_count


@kernel()
def place_vertices(
    first_block: int,
    last_block: int,
    volume: VolumeArrays,
    crossed: UInt8[np.ndarray, "b 512"],
    starts: Int64[np.ndarray, " b"],
    first: Int32[np.ndarray, "b 512"],
    points: Float32[np.ndarray, "v 3"],
) -> None:
    """Place vertices where values change sign along edges, in voxels from the grid's first voxel centre.

    ``first`` gets the number of each voxel's first vertex.
    """
    blocks = volume.blocks
    for b in range(first_block, last_block):
        near = block_values(volume, b)
        number = starts[b]
        for voxel in range(BLOCK_VOXELS):
            x, y, z, at = voxel_place(voxel)
            first[b, voxel] = number
            for axis in range(3):
                if crossed[b, voxel] >> axis & 1:
                    here, there = near[at], near[at + corner_offset(1 << axis)]
                    # Not quite to the ends, where triangles would lose their area.
                    t = min(max(here / (here - there), np.float32(0.01)), np.float32(0.99))
                    points[number, 0] = blocks[b, 0] * BLOCK_SIDE + x
                    points[number, 1] = blocks[b, 1] * BLOCK_SIDE + y
                    points[number, 2] = blocks[b, 2] * BLOCK_SIDE + z
                    points[number, axis] += t
                    number += 1


@kernel()
def place_triangles(
    first_block: int,
    last_block: int,
    volume: VolumeArrays,
    edge_corners: Int32[np.ndarray, "12 2"],
    edge_table: Int8[np.ndarray, "256 _"],
    triangle_counts: Int32[np.ndarray, "256"],
    crossed: UInt8[np.ndarray, "b 512"],
    first: Int32[np.ndarray, "b 512"],
    starts: Int64[np.ndarray, " b"],
    faces: Int32[np.ndarray, "f 3"],
) -> None:
    """Place the triangles of the cells, in the order of the blocks ``first_block`` to ``last_block``."""
    for b in range(first_block, last_block):
        near = block_values(volume, b)
        number = starts[b]
        for voxel in range(BLOCK_VOXELS):
            x, y, z, at = voxel_place(voxel)
            if np.isnan(near[at]):  # its cell's first corner is unknown
                continue
            case = cube_case(near, at)
            for k in range(3 * triangle_counts[case]):
                edge = edge_table[case, k]
                low = edge_corners[edge, 0]
                axis = edge // 4
                row, place = neighbour(
                    volume.table,
                    volume.blocks,
                    b,
                    x + (low & 1),
                    y + (low >> 1 & 1),
                    z + (low >> 2 & 1),
                )
                # the owner's vertices come in the order of its crossed axes
                vertex = first[row, place]
                for before in range(axis):
                    vertex += crossed[row, place] >> before & 1
                faces[number + k // 3, k % 3] = vertex
            number += triangle_counts[case]
