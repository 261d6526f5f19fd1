"""Traversal of the hierarchy by a packet: one frustum around its rays, and what overlaps it.

Boxes and ellipses are tested in float32, eight at once, with a margin for rounding: a candidate may lie just
beside the frustum, but no Gaussian that a ray meets is left out.
"""

import math

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.compilation import device_function
from octasplat.engine.trace.cpu.kernels.kernel_args import (
    BvhArrays,
    Candidates,
    Frustum,
    RayArrays,
    TraversalScratch,
)
from octasplat.engine.trace.cpu.kernels.packet_bvh import BOX_ROWS, LEAF_ROWS, WIDTH
from octasplat.engine.trace.cpu.kernels.ray_mask import (
    BINS,
    FRAME_WORDS,
    ellipse_bins,
    rays_in_bins,
    write_ray_bins,
)
from octasplat.engine.trace.cpu.kernels.rays import ray_slopes
from octasplat.engine.trace.cpu.kernels.simd_vector import (
    FRUSTUM_PLANES,
    PLANE_WORDS,
    boxes_in_frustum,
    ellipses_in_frustum,
    float32_bits,
    lowest_bit,
)
from octasplat.engine.trace.kernels.native import njit_no_refcount, prefetch_bytes

STACK_WORDS = 1024
"""Words for the nodes that wait, two each; a walk goes down at once, so that seven wait on each level."""
BLOCK_QUEUE_SIZE = 64
"""Blocks that may wait to be tested: enough that memory has answered when their turn comes."""
NODE_BYTES, LEAF_BLOCK_BYTES = BOX_ROWS * WIDTH * 4, LEAF_ROWS * WIDTH * 4
SLOPE_MARGIN = 1e-9
"""The pyramid is wider than its rays by this, which covers the rounding of slopes in float64."""


@device_function(error_model="numpy")
def allocate_frustum() -> Frustum:
    """Return room for a pyramid."""
    return Frustum(
        np.empty((FRUSTUM_PLANES, PLANE_WORDS), np.float32),
        np.empty(FRAME_WORDS, np.float64),
        np.empty(FRAME_WORDS, np.float32),
        np.empty((2, BINS + 1), np.uint64),
    )


@device_function(error_model="numpy")
def allocate_traversal() -> TraversalScratch:
    """Return memory for walks, one after another."""
    return TraversalScratch(
        np.empty(STACK_WORDS, np.int64),
        np.empty(BLOCK_QUEUE_SIZE, np.int64),
        np.empty((4, WIDTH), np.int32),
        np.empty((2, WIDTH), np.float32),
        np.empty(256, np.int32),
    )


@njit_no_refcount(forceinline=True)
def write_plane(plane: Float32[np.ndarray, "9"], x: float, y: float, z: float) -> None:
    """Write a normal, its positive parts, which take a high corner, and its negative ones."""
    plane[0], plane[1], plane[2] = x, y, z
    plane[3], plane[4], plane[5] = max(x, 0.0), max(y, 0.0), max(z, 0.0)
    plane[6], plane[7], plane[8] = min(x, 0.0), min(y, 0.0), min(z, 0.0)


@njit_no_refcount()
def write_frustum(rays: RayArrays, first: int, last: int, frustum: Frustum) -> None:
    """Write the pyramid around rays ``first`` to ``last``."""
    planes, frame, directions = frustum.planes, frustum.frame, rays.directions
    # --- the axis: the mean direction ---
    x = y = z = 0.0
    for r in range(first, last):
        x += directions[r, 0]
        y += directions[r, 1]
        z += directions[r, 2]
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    x, y, z = x * scale, y * scale, z * scale
    # any frame around the axis
    if abs(x) < 0.6:
        e0, e1, e2 = 0.0, z, -y
    else:
        e0, e1, e2 = -z, 0.0, x
    scale = 1.0 / math.sqrt(e0 * e0 + e1 * e1 + e2 * e2)
    e0, e1, e2 = e0 * scale, e1 * scale, e2 * scale
    f0, f1, f2 = y * e2 - z * e1, z * e0 - x * e2, x * e1 - y * e0
    frame[0], frame[1], frame[2] = x, y, z
    frame[3], frame[4], frame[5] = e0, e1, e2
    frame[6], frame[7], frame[8] = f0, f1, f2
    # --- slopes along e and f that enclose all rays, and the planes through them ---
    a_low = b_low = np.inf
    a_high = b_high = -np.inf
    for r in range(first, last):
        a, b, _per_axis = ray_slopes(rays, r, frame)
        a_low, a_high, b_low, b_high = min(a_low, a), max(a_high, a), min(b_low, b), max(b_high, b)
    a_low, a_high = a_low - SLOPE_MARGIN, a_high + SLOPE_MARGIN
    b_low, b_high = b_low - SLOPE_MARGIN, b_high + SLOPE_MARGIN
    write_plane(planes[0], e0 - a_low * x, e1 - a_low * y, e2 - a_low * z)
    write_plane(planes[1], a_high * x - e0, a_high * y - e1, a_high * z - e2)
    write_plane(planes[2], f0 - b_low * x, f1 - b_low * y, f2 - b_low * z)
    write_plane(planes[3], b_high * x - f0, b_high * y - f1, b_high * z - f2)
    write_plane(planes[4], x, y, z)  # across the axis: nothing behind the origin
    frame[9], frame[10], frame[11], frame[12] = a_low, a_high, b_low, b_high
    write_ray_bins(rays, first, last, frame, frustum.prefix_masks)
    for k in range(FRAME_WORDS):
        frustum.frame_float32[k] = np.float32(frame[k])


@njit_no_refcount(fastmath={"contract"})
def gather_candidates(
    bvh: BvhArrays,
    frustum: Frustum,
    origin: tuple[float, float, float],
    t_max: float,
    traversal: TraversalScratch,
    candidates: Candidates,
) -> int:
    """Gather the Gaussians whose ellipse a ray of the frustum may meet before ``t_max``; return how many.

    Only as many as fit are written. Blocks are prefetched when their box is reached, and tested in batches.
    """
    stack, blocks, level_starts = traversal.stack, traversal.block_queue, bvh.level_starts
    ox, oy, oz = np.float32(origin[0]), np.float32(origin[1]), np.float32(origin[2])
    nodes_at, blocks_at = bvh.nodes.ctypes.data, bvh.leaf_blocks.ctypes.data
    planes_at = frustum.planes.ctypes.data
    top = len(level_starts) - 2
    stack[0], stack[1] = level_starts[top], top  # the one node of the top level
    depth, waiting, n_found = 1, 0, 0
    while depth > 0 or waiting > 0:
        # Test when the queue has no room for another node's eight blocks, or nothing else is left.
        if depth == 0 or waiting > BLOCK_QUEUE_SIZE - WIDTH:
            n_found = test_blocks(bvh, frustum, origin, t_max, traversal, waiting, candidates, n_found)
            waiting = 0
            continue
        depth -= 1
        node, level = stack[2 * depth], stack[2 * depth + 1]
        mask = boxes_in_frustum(nodes_at + node * NODE_BYTES, planes_at, ox, oy, oz)
        first_child = (node - level_starts[level]) * WIDTH
        while mask != 0:
            child = first_child + lowest_bit(mask)
            mask &= mask - 1
            if level == 0:
                prefetch_bytes(blocks_at + child * LEAF_BLOCK_BYTES, LEAF_BLOCK_BYTES)
                blocks[waiting] = child
                # depth first, so that the stack stays short
                waiting += 1
            else:
                child += level_starts[level - 1]
                prefetch_bytes(nodes_at + child * NODE_BYTES, NODE_BYTES)
                stack[2 * depth], stack[2 * depth + 1] = child, level - 1
                depth += 1
    return n_found


@njit_no_refcount(fastmath={"contract"})
def test_blocks(
    bvh: BvhArrays,
    frustum: Frustum,
    origin: tuple[float, float, float],
    t_max: float,
    traversal: TraversalScratch,
    count: int,
    candidates: Candidates,
    candidate_count: int,
) -> int:
    """Append the candidates of the ``count`` blocks that wait to the ``candidate_count`` so far.

    Returns the sum.
    """
    ox, oy, oz = np.float32(origin[0]), np.float32(origin[1]), np.float32(origin[2])
    bins, distances, room = traversal.bins, traversal.distances, len(candidates.curve_indices)
    planes_at, frame_at = frustum.planes.ctypes.data, frustum.frame_float32.ctypes.data
    for w in range(count):
        block = traversal.block_queue[w]
        block_at = bvh.leaf_blocks.ctypes.data + block * LEAF_BLOCK_BYTES
        reached = ellipses_in_frustum(block_at, planes_at, ox, oy, oz)
        if reached != 0:
            reached &= ellipse_bins(block_at, frame_at, ox, oy, oz, bins.ctypes.data, distances.ctypes.data)
        while reached != 0:
            lane = lowest_bit(reached)
            reached &= reached - 1
            if distances[0, lane] >= t_max:
                continue
            rays, cell = rays_in_bins(bins, lane, frustum.prefix_masks)
            if rays == 0:
                continue  # it lies between the rays
            if candidate_count < room:
                candidates.curve_indices[candidate_count] = block * WIDTH + lane
                # non-negative floats sort like their bits
                likely = np.uint64(float32_bits(distances[1, lane]))
                candidates.keys[candidate_count] = (likely << np.uint64(32)) | np.uint64(candidate_count)
                candidates.min_distances[candidate_count] = distances[0, lane]
                candidates.cells[candidate_count] = cell
                candidates.ray_masks[candidate_count] = rays
            candidate_count += 1
    return candidate_count
