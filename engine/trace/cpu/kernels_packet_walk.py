"""The walk of a packet: one pyramid around its rays, and what reaches into it.

Boxes and ellipses are tested in float32, eight at once, with room for rounding: what is found may lie just
beside the pyramid, but nothing that a ray meets is left out.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64, UInt64

from octasplat.engine.compilation import device_function
from octasplat.engine.trace.cpu.kernels_footprint import (
    BINS,
    FRAME_WORDS,
    footprints,
    rays_between,
    write_bins,
)
from octasplat.engine.trace.cpu.kernels_rays import ray_slopes
from octasplat.engine.trace.cpu.kernels_simd import (
    PLANE_WORDS,
    SIDES,
    boxes_in_pyramid,
    ellipses_in_pyramid,
    float32_bits,
    lowest_bit,
)
from octasplat.engine.trace.cpu.kernels_tree import BOX_ROWS, LEAF_ROWS, WIDTH
from octasplat.engine.trace.kernels_native import ask_for, lean

STACK = 1024
"""Words for the nodes that wait, two each; a walk goes down at once, so that seven wait on each level."""
BLOCKS = 64
"""Blocks that may wait to be tested: enough that memory has answered when their turn comes."""
NODE_BYTES, BLOCK_BYTES = BOX_ROWS * WIDTH * 4, LEAF_ROWS * WIDTH * 4
SLOPE_ROOM = 1e-9
"""The pyramid is wider than its rays by this, which covers the rounding of slopes in float64."""


class Tree(NamedTuple):
    """The hierarchy; :mod:`octasplat.engine.trace.cpu.kernels_tree` says how it is laid out."""

    nodes: Float32[np.ndarray, "m 6 8"]
    level_starts: Int64[np.ndarray, " l"]
    blocks: Float32[np.ndarray, "b 9 8"]
    order: Int32[np.ndarray, " k"]


class Pyramid(NamedTuple):
    """The pyramid around the rays of a packet.

    ``planes`` are inward normals, their positive and their negative parts; ``frame`` the axis, two directions
    across it, the range of slopes and bins per slope, and ``singles`` the same in float32; ``below`` the bits
    of the rays in the bins before each, along either slope.
    """

    planes: Float32[np.ndarray, "5 9"]
    frame: Float64[np.ndarray, "15"]
    singles: Float32[np.ndarray, "15"]
    below: UInt64[np.ndarray, "2 65"]


class Walk(NamedTuple):
    """Memory of a walk: waiting nodes and blocks, bins and distances of a block, and buckets for sorting."""

    stack: Int64[np.ndarray, " s"]
    blocks: Int64[np.ndarray, " w"]
    bins: Int32[np.ndarray, "4 8"]
    distances: Float32[np.ndarray, "2 8"]
    histogram: Int32[np.ndarray, "256"]


@device_function(error_model="numpy")
def new_pyramid():
    """Room for a pyramid."""
    return Pyramid(
        np.empty((SIDES, PLANE_WORDS), np.float32),
        np.empty(FRAME_WORDS, np.float64),
        np.empty(FRAME_WORDS, np.float32),
        np.empty((2, BINS + 1), np.uint64),
    )


@device_function(error_model="numpy")
def new_walk():
    """Memory for walks, one after another."""
    return Walk(
        np.empty(STACK, np.int64),
        np.empty(BLOCKS, np.int64),
        np.empty((4, WIDTH), np.int32),
        np.empty((2, WIDTH), np.float32),
        np.empty(256, np.int32),
    )


@lean(forceinline=True)
def write_plane(plane, x, y, z):
    """A normal, its positive parts, which take a high corner, and its negative ones, which take a low."""
    plane[0], plane[1], plane[2] = x, y, z
    plane[3], plane[4], plane[5] = max(x, 0.0), max(y, 0.0), max(z, 0.0)
    plane[6], plane[7], plane[8] = min(x, 0.0), min(y, 0.0), min(z, 0.0)


@lean()
def write_pyramid(rays, first, last, pyramid):
    """The pyramid around rays ``first`` to ``last``."""
    planes, frame, directions = pyramid.planes, pyramid.frame, rays.directions
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
    a_low = b_low = np.inf
    a_high = b_high = -np.inf
    for r in range(first, last):
        a, b, _per_axis = ray_slopes(rays, r, frame)
        a_low, a_high, b_low, b_high = min(a_low, a), max(a_high, a), min(b_low, b), max(b_high, b)
    a_low, a_high = a_low - SLOPE_ROOM, a_high + SLOPE_ROOM
    b_low, b_high = b_low - SLOPE_ROOM, b_high + SLOPE_ROOM
    write_plane(planes[0], e0 - a_low * x, e1 - a_low * y, e2 - a_low * z)
    write_plane(planes[1], a_high * x - e0, a_high * y - e1, a_high * z - e2)
    write_plane(planes[2], f0 - b_low * x, f1 - b_low * y, f2 - b_low * z)
    write_plane(planes[3], b_high * x - f0, b_high * y - f1, b_high * z - f2)
    write_plane(planes[4], x, y, z)
    frame[9], frame[10], frame[11], frame[12] = a_low, a_high, b_low, b_high
    write_bins(rays, first, last, frame, pyramid.below)
    for k in range(FRAME_WORDS):
        pyramid.singles[k] = np.float32(frame[k])


@lean(fastmath={"contract"})
def gather_candidates(tree, pyramid, origin, farthest, walk, candidates):
    """The Gaussians whose ellipse a ray of the pyramid may meet before ``farthest``; returns how many.

    Only as many as there is room for are written. Blocks are asked for when their box is reached, and tested
    when many wait.
    """
    stack, blocks, level_starts = walk.stack, walk.blocks, tree.level_starts
    ox, oy, oz = np.float32(origin[0]), np.float32(origin[1]), np.float32(origin[2])
    nodes_at, blocks_at = tree.nodes.ctypes.data, tree.blocks.ctypes.data
    planes_at = pyramid.planes.ctypes.data
    top = len(level_starts) - 2
    stack[0], stack[1] = level_starts[top], top
    depth, waiting, n_found = 1, 0, 0
    while depth > 0 or waiting > 0:
        if depth == 0 or waiting > BLOCKS - WIDTH:
            n_found = test_blocks(tree, pyramid, origin, farthest, walk, waiting, candidates, n_found)
            waiting = 0
            continue
        depth -= 1
        node, level = stack[2 * depth], stack[2 * depth + 1]
        mask = boxes_in_pyramid(nodes_at + node * NODE_BYTES, planes_at, ox, oy, oz)
        first_child = (node - level_starts[level]) * WIDTH
        while mask != 0:
            child = first_child + lowest_bit(mask)
            mask &= mask - 1
            if level == 0:
                ask_for(blocks_at + child * BLOCK_BYTES, BLOCK_BYTES)
                blocks[waiting] = child
                waiting += 1
            else:
                child += level_starts[level - 1]
                ask_for(nodes_at + child * NODE_BYTES, NODE_BYTES)
                stack[2 * depth], stack[2 * depth + 1] = child, level - 1
                depth += 1
    return n_found


@lean(fastmath={"contract"})
def test_blocks(tree, pyramid, origin, farthest, walk, count, candidates, n_found):
    """Append the candidates of the ``count`` blocks that wait to the ``n_found`` so far; returns the sum."""
    ox, oy, oz = np.float32(origin[0]), np.float32(origin[1]), np.float32(origin[2])
    bins, distances, room = walk.bins, walk.distances, len(candidates.found)
    planes_at, frame_at = pyramid.planes.ctypes.data, pyramid.singles.ctypes.data
    for w in range(count):
        block = walk.blocks[w]
        block_at = tree.blocks.ctypes.data + block * BLOCK_BYTES
        reached = ellipses_in_pyramid(block_at, planes_at, ox, oy, oz)
        if reached != 0:
            reached &= footprints(block_at, frame_at, ox, oy, oz, bins.ctypes.data, distances.ctypes.data)
        while reached != 0:
            lane = lowest_bit(reached)
            reached &= reached - 1
            if distances[0, lane] >= farthest:
                continue
            rays, cell = rays_between(bins, lane, pyramid.below)
            if rays == 0:
                continue  # it lies between the rays
            if n_found < room:
                candidates.found[n_found] = block * WIDTH + lane
                # non-negative floats sort like their bits
                likely = np.uint64(float32_bits(distances[1, lane]))
                candidates.keys[n_found] = (likely << np.uint64(32)) | np.uint64(n_found)
                candidates.bounds[n_found] = distances[0, lane]
                candidates.cells[n_found] = cell
                candidates.masks[n_found] = rays
            n_found += 1
    return n_found
