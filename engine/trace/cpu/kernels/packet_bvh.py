"""A hierarchy for packets of rays: boxes over blocks of eight Gaussians along a space-filling curve.

It costs one sort and one pass over the Gaussians to build, 48 bytes a Gaussian, and needs no pointers:
block b holds the Gaussians ``order[8 b : 8 b + 8]``, and box b of level l + 1 bounds the boxes 8 b to 8 b +
7 of level l. A packet visits it once for all its rays, so that its boxes may be looser than those a single
ray wants.
"""

import math

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32, Int64, UInt64

from octasplat.engine.core.compilation import device_function, kernel
from octasplat.engine.gaussians.kernels.morton_bits import spread_bits
from octasplat.engine.trace.cpu.kernels.octagon_hit import AXIS_U, AXIS_V, COS_22, INNER_RADIUS, MEAN

WIDTH = 8
BOX_ROWS = 6
"""Rows of a node: low x, y, z and high x, y, z of its eight boxes."""
LEAF_ROWS = 9
"""Rows of a block: mean x, y, z and the ellipse's legs R s2 r2 and R s3 r3 of its eight Gaussians."""
AXIS_MARGIN = 1.0 + 1e-5
"""Legs are this much longer than the octagon's corners, which covers their rounding to float32."""
BOX_ROUNDING = 4e-6
"""Boxes are this much larger, as a fraction of what they are computed from: room for float32."""
INVALID_KEY = np.uint64(0xFFFFFFFFFFFFFFFF)
"""Key of a Gaussian that is not finite."""
KEY_BITS = 64
_CURVE_BITS = 19
MAX_CELL = (1 << _CURVE_BITS) - 1
_SIZE_CLASSES = 32


_spread_bits = device_function(_nrt=False, error_model="numpy")(spread_bits)


@kernel(_nrt=False, error_model="numpy")
def morton_keys(
    first: int,
    last: int,
    primitives: Float32[np.ndarray, "n 16"],
    low: Float64[np.ndarray, "3"],
    inverse_cell: float,
    keys: UInt64[np.ndarray, " n"],
) -> None:
    """Return keys along a Z-order curve, with the size class (factors of four, large ones first) on top.

    Without the classes one large Gaussian would enlarge the box of its small neighbours. A Gaussian without
    an octagon may get one before the next build, so it has a key, too; one that is not a number has none.
    """
    for i in range(first, last):
        radius = max(np.float64(primitives[i, INNER_RADIUS]), 0.0) / COS_22
        u2 = v2 = total = 0.0
        for axis in range(3):
            u2 += np.float64(primitives[i, AXIS_U + axis]) ** 2
            v2 += np.float64(primitives[i, AXIS_V + axis]) ** 2
            total += primitives[i, MEAN + axis]
        # the axes are r2 / s2 and r3 / s3: the shorter one is that of the larger scale
        size = radius / math.sqrt(min(u2, v2))
        if not (size < 1e30 and math.isfinite(total)):
            keys[i] = INVALID_KEY
            continue
        # half a binary logarithm: factors of four
        level = min(int(0.5 * math.log2(max(size * inverse_cell, 1.0))), _SIZE_CLASSES - 1)
        key = np.uint64(_SIZE_CLASSES - 1 - level) << np.uint64(3 * _CURVE_BITS)  # large ones first
        for axis in range(3):
            cell = (np.float64(primitives[i, MEAN + axis]) - low[axis]) * inverse_cell
            # interleaved x, y, z
            key |= _spread_bits(np.uint64(min(max(cell, 0.0), MAX_CELL))) << np.uint64(axis)
        keys[i] = key


@device_function(_nrt=False, error_model="numpy")
def write_leaf(
    blocks: Float32[np.ndarray, "b 9 8"], slot: int, primitives: Float32[np.ndarray, "n 16"], i: int
) -> None:
    """Write mean and legs of Gaussian ``i`` to its lane; a vanished octagon gets not-a-number legs."""
    block, lane = slot // WIDTH, slot % WIDTH
    radius = np.float64(primitives[i, INNER_RADIUS]) / COS_22 * AXIS_MARGIN
    u2 = v2 = 0.0
    for axis in range(3):
        u2 += np.float64(primitives[i, AXIS_U + axis]) ** 2
        v2 += np.float64(primitives[i, AXIS_V + axis]) ** 2
    # the record's axes are r2/s2 and r3/s3, and r2 s2 = axis / |axis|^2
    scale_u = radius / u2 if radius > 0.0 else np.nan
    scale_v = radius / v2 if radius > 0.0 else np.nan
    for axis in range(3):
        blocks[block, axis, lane] = primitives[i, MEAN + axis]
        blocks[block, 3 + axis, lane] = primitives[i, AXIS_U + axis] * scale_u
        blocks[block, 6 + axis, lane] = primitives[i, AXIS_V + axis] * scale_v


@device_function(_nrt=False, error_model="numpy")
def write_block_box(
    blocks: Float32[np.ndarray, "b 9 8"], b: int, nodes: Float32[np.ndarray, "m 6 8"]
) -> None:
    """Write the box of block ``b`` at level 0, around the ellipses that have not vanished."""
    lo0 = lo1 = lo2 = np.inf
    hi0 = hi1 = hi2 = -np.inf
    for lane in range(WIDTH):
        if math.isnan(blocks[b, 3, lane]):
            continue
        u0, u1, u2 = (
            np.float64(blocks[b, 3, lane]),
            np.float64(blocks[b, 4, lane]),
            np.float64(blocks[b, 5, lane]),
        )
        v0, v1, v2 = (
            np.float64(blocks[b, 6, lane]),
            np.float64(blocks[b, 7, lane]),
            np.float64(blocks[b, 8, lane]),
        )
        h0 = math.sqrt(u0 * u0 + v0 * v0)
        h1 = math.sqrt(u1 * u1 + v1 * v1)
        h2 = math.sqrt(u2 * u2 + v2 * v2)
        m0, m1, m2 = (
            np.float64(blocks[b, 0, lane]),
            np.float64(blocks[b, 1, lane]),
            np.float64(blocks[b, 2, lane]),
        )
        h0 += BOX_ROUNDING * (abs(m0) + h0)
        h1 += BOX_ROUNDING * (abs(m1) + h1)
        h2 += BOX_ROUNDING * (abs(m2) + h2)
        lo0, lo1, lo2 = min(lo0, m0 - h0), min(lo1, m1 - h1), min(lo2, m2 - h2)
        hi0, hi1, hi2 = max(hi0, m0 + h0), max(hi1, m1 + h1), max(hi2, m2 + h2)
    node, lane = b // WIDTH, b % WIDTH
    nodes[node, 0, lane], nodes[node, 1, lane], nodes[node, 2, lane] = lo0, lo1, lo2
    nodes[node, 3, lane], nodes[node, 4, lane], nodes[node, 5, lane] = hi0, hi1, hi2


@kernel(_nrt=False, error_model="numpy")
def write_leaves(
    first: int,
    last: int,
    blocks: Float32[np.ndarray, "b 9 8"],
    slots: Int32[np.ndarray, " n"],
    primitives: Float32[np.ndarray, "n 16"],
    order: Int32[np.ndarray, " n"],
    nodes: Float32[np.ndarray, "m 6 8"],
) -> None:
    """Write blocks in curve order, each Gaussian's place in them, and the boxes of the blocks (level 0)."""
    count = len(order)
    for b in range(first, last):
        for lane in range(WIDTH):
            k = b * WIDTH + lane
            if k >= count:
                for row in range(LEAF_ROWS):
                    blocks[b, row, lane] = np.nan
                continue
            slots[order[k]] = k
            write_leaf(blocks, k, primitives, order[k])
        write_block_box(blocks, b, nodes)


@device_function(_nrt=False, error_model="numpy")
def write_node_box(nodes: Float32[np.ndarray, "m 6 8"], child: int, parent: int, lane: int) -> None:
    """Write box ``lane`` of ``parent``, around the eight boxes of ``child``."""
    for row in range(3):
        low, high = nodes[child, row, 0], nodes[child, 3 + row, 0]
        for other in range(1, WIDTH):
            low, high = min(low, nodes[child, row, other]), max(high, nodes[child, 3 + row, other])
        nodes[parent, row, lane], nodes[parent, 3 + row, lane] = low, high


@kernel(_nrt=False, error_model="numpy")
def write_upper_levels(nodes: Float32[np.ndarray, "m 6 8"], level_starts: Int64[np.ndarray, " l"]) -> None:
    """Write boxes of every level above the first; node k of a level bounds box k of the next."""
    for level in range(1, len(level_starts) - 1):
        below, here = level_starts[level - 1], level_starts[level]
        for k in range(here - below):
            write_node_box(nodes, below + k, here + k // WIDTH, k % WIDTH)


@kernel(_nrt=False, error_model="numpy")
def update_leaves(
    first: int,
    last: int,
    blocks: Float32[np.ndarray, "b 9 8"],
    slots: Int32[np.ndarray, " n"],
    primitives: Float32[np.ndarray, "n 16"],
    ids: Int32[np.ndarray, " u"],
    dirty: Bool[np.ndarray, " b"],
) -> None:
    """Rewrite the lanes of Gaussians whose primitives changed, and mark their blocks."""
    for k in range(first, last):
        slot = slots[ids[k]]
        if slot >= 0:
            write_leaf(blocks, slot, primitives, ids[k])
            dirty[slot // WIDTH] = True


@kernel(_nrt=False, error_model="numpy")
def refit_blocks(
    first: int,
    last: int,
    blocks: Float32[np.ndarray, "b 9 8"],
    dirty: Bool[np.ndarray, " b"],
    nodes: Float32[np.ndarray, "m 6 8"],
) -> None:
    """Write the boxes of the blocks that were touched, and of no others."""
    for b in range(first, last):
        if dirty[b]:
            write_block_box(blocks, b, nodes)
            dirty[b] = False
