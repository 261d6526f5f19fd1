"""Depth maps into blocks of voxels: which blocks a surface passes, and the fused signed distances."""

import math

import numpy as np
from numba import prange

from octasplat.engine.core.compilation import device_function, kernel

BLOCK = 8
VOXELS_PER_BLOCK = BLOCK**3
NO_BLOCK = -1
FREE_WEIGHT = 0.3
MIN_WEIGHT = 0.05
TILE = 16
BLOCK_BEHIND, BLOCK_IN_FRONT, BLOCK_NEAR = 0, 1, 2
MARGIN_VOXELS = 2.0
"""Blocks are taken this far around a band, so that cells at its rim find all of their corners."""


@device_function()
def contract(x, y, z):
    """Contracted position of a point in units of the unit ball."""
    length = math.sqrt(x * x + y * y + z * z)
    if length <= 1.0:
        return x, y, z
    factor = (2.0 - 1.0 / length) / length
    return x * factor, y * factor, z * factor


@device_function()
def expand(x, y, z):
    """The way back from :func:`contract`, and how much lengths grow on it, at most (1 inside the ball).

    Points on and beyond the rim of contracted space, which stand for infinity, give a stretch of 0.
    """
    length = math.sqrt(x * x + y * y + z * z)
    if length <= 1.0:
        return x, y, z, 1.0
    if length >= 1.999:
        return x, y, z, 0.0
    world = 1.0 / (2.0 - length)
    factor = world / length
    return x * factor, y * factor, z * factor, world * world


@kernel(parallel=True)
def mark_blocks(
    distances, fx, fy, cx, cy, rotation, centre, low, voxel, contracted, middle, radius, truncation, marks
):  # fmt: skip
    """Set ``marks`` of the blocks within ``truncation`` voxels (along the ray) of a depth map's points.

    ``rotation`` takes world to camera directions. Threads may set one mark twice, which is harmless.
    """
    height, width = distances.shape
    nx, ny, nz = marks.shape
    for row in prange(height):
        for column in range(width):
            distance = np.float64(distances[row, column])
            if distance <= 0.0 or not math.isfinite(distance):
                continue
            dx, dy = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
            scale = 1.0 / math.sqrt(dx * dx + dy * dy + 1.0)
            wx = (rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0]) * scale
            wy = (rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1]) * scale
            wz = (rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2]) * scale
            step = voxel * radius
            if contracted:
                px = (centre[0] + wx * distance - middle[0]) / radius
                py = (centre[1] + wy * distance - middle[1]) / radius
                pz = (centre[2] + wz * distance - middle[2]) / radius
                step *= max(1.0, px * px + py * py + pz * pz)
            reach = truncation * step
            stride = 0.5 * BLOCK * step
            steps = math.ceil(2.0 * reach / stride)
            for k in range(steps + 1):
                t = max(0.0, distance - reach + k * (2.0 * reach / steps))
                px = (centre[0] + wx * t - middle[0]) / radius
                py = (centre[1] + wy * t - middle[1]) / radius
                pz = (centre[2] + wz * t - middle[2]) / radius
                if contracted:
                    px, py, pz = contract(px, py, pz)
                gx = (px - low[0]) / voxel
                gy = (py - low[1]) / voxel
                gz = (pz - low[2]) / voxel
                x0 = max(0, math.floor((gx - MARGIN_VOXELS) / BLOCK))
                x1 = min(nx - 1, math.floor((gx + MARGIN_VOXELS) / BLOCK))
                y0 = max(0, math.floor((gy - MARGIN_VOXELS) / BLOCK))
                y1 = min(ny - 1, math.floor((gy + MARGIN_VOXELS) / BLOCK))
                z0 = max(0, math.floor((gz - MARGIN_VOXELS) / BLOCK))
                z1 = min(nz - 1, math.floor((gz + MARGIN_VOXELS) / BLOCK))
                for bx in range(x0, x1 + 1):
                    for by in range(y0, y1 + 1):
                        for bz in range(z0, z1 + 1):
                            marks[bx, by, bz] = 1


@device_function()
def depth_at(distances, cosines, u, v, jump):
    """Distance and cosine at an image point: bilinear on one surface, else of the pixel itself.

    Four pixels lie on one surface where all are known and differ by no more than ``jump``.
    """
    height, width = distances.shape
    column, row = int(u), int(v)
    nearest, cosine = np.float64(distances[row, column]), np.float64(cosines[row, column])
    x0, y0 = math.floor(u - 0.5), math.floor(v - 0.5)
    if x0 < 0 or y0 < 0 or x0 + 1 >= width or y0 + 1 >= height:
        return nearest, cosine
    a, b = np.float64(distances[y0, x0]), np.float64(distances[y0, x0 + 1])
    c, d = np.float64(distances[y0 + 1, x0]), np.float64(distances[y0 + 1, x0 + 1])
    least, most = min(min(a, b), min(c, d)), max(max(a, b), max(c, d))
    if not (least > 0.0 and most - least <= jump):
        return nearest, cosine
    tx, ty = u - 0.5 - x0, v - 0.5 - y0
    return (a * (1 - tx) + b * tx) * (1 - ty) + (c * (1 - tx) + d * tx) * ty, cosine


@kernel()
def tile_ranges(distances, nearest, farthest):
    """Least and largest distance in each tile of 16 x 16 pixels; unknown ones count as 0."""
    height, width = distances.shape
    nearest[:], farthest[:] = np.inf, 0.0
    for row in range(height):
        for column in range(width):
            y, x = row // TILE, column // TILE
            nearest[y, x] = min(nearest[y, x], distances[row, column])
            farthest[y, x] = max(farthest[y, x], distances[row, column])


@device_function()
def classify_block(
    ox, oy, oz, half, band, fx, fy, cx, cy, rotation, width, height, nearest, farthest
):  # fmt: skip
    """Where a block lies whose centre is (ox, oy, oz) from the camera: ``BLOCK_BEHIND``, ``BLOCK_IN_FRONT`` or ``BLOCK_NEAR``.

    ``half`` is the radius of a ball around it.
    """
    z = rotation[2, 0] * ox + rotation[2, 1] * oy + rotation[2, 2] * oz
    if z + half <= 0.0:
        return BLOCK_BEHIND
    if z - half <= 0.1 * half:
        return BLOCK_NEAR
    x = rotation[0, 0] * ox + rotation[0, 1] * oy + rotation[0, 2] * oz
    y = rotation[1, 0] * ox + rotation[1, 1] * oy + rotation[1, 2] * oz
    # The box of the ball, seen from the origin, lies between its slopes at the near and at the far side.
    left = fx * min((x - half) / (z - half), (x - half) / (z + half)) + cx
    right = fx * max((x + half) / (z - half), (x + half) / (z + half)) + cx
    top = fy * min((y - half) / (z - half), (y - half) / (z + half)) + cy
    bottom = fy * max((y + half) / (z - half), (y + half) / (z + half)) + cy
    if right < 0.0 or bottom < 0.0 or left >= width or top >= height:
        return BLOCK_BEHIND
    # One pixel more, as depths are interpolated.
    x0, x1 = max(0, int(left) - 1) // TILE, min(width - 1, int(right) + 1) // TILE
    y0, y1 = max(0, int(top) - 1) // TILE, min(height - 1, int(bottom) + 1) // TILE
    least, most = np.inf, 0.0
    for row in range(y0, y1 + 1):
        for column in range(x0, x1 + 1):
            least, most = min(least, nearest[row, column]), max(most, farthest[row, column])
    length = math.sqrt(ox * ox + oy * oy + oz * oz)
    if length - half > most + band:
        return BLOCK_BEHIND
    inside = left >= 0.0 and top >= 0.0 and right < width and bottom < height
    if inside and length + half + band < least:
        return BLOCK_IN_FRONT
    return BLOCK_NEAR


@kernel(parallel=True)
def fuse_view(
    distances, cosines, nearest, farthest, fx, fy, cx, cy, rotation, centre,
    low, voxel, contracted, middle, radius, truncation, blocks, values, weights,
):  # fmt: skip
    """Add one depth map to the running means of signed distances, in units of the truncation.

    Positive in front of the surface, negative behind. The distance along the ray times the cosine is the
    distance to the tangent plane; the weight is the cosine too, as oblique depths are the less certain.
    """
    height, width = distances.shape
    for b in prange(len(blocks)):
        base_x, base_y, base_z = blocks[b, 0] * BLOCK, blocks[b, 1] * BLOCK, blocks[b, 2] * BLOCK
        if not contracted:
            lies = classify_block(
                low[0] + (base_x + 0.5 * BLOCK) * voxel - centre[0],
                low[1] + (base_y + 0.5 * BLOCK) * voxel - centre[1],
                low[2] + (base_z + 0.5 * BLOCK) * voxel - centre[2],
                0.5 * BLOCK * voxel * math.sqrt(3.0), truncation * voxel,
                fx, fy, cx, cy, rotation, width, height, nearest, farthest,
            )  # fmt: skip
            if lies == BLOCK_BEHIND:
                continue
            if lies == BLOCK_IN_FRONT:
                for k in range(VOXELS_PER_BLOCK):
                    total = weights[b, k] + FREE_WEIGHT
                    values[b, k] += (1.0 - values[b, k]) * (FREE_WEIGHT / total)
                    weights[b, k] = total
                continue
        for k in range(VOXELS_PER_BLOCK):
            gx = low[0] + (base_x + k // (BLOCK * BLOCK) + 0.5) * voxel
            gy = low[1] + (base_y + (k // BLOCK) % BLOCK + 0.5) * voxel
            gz = low[2] + (base_z + k % BLOCK + 0.5) * voxel
            stretch = 1.0
            if contracted:
                gx, gy, gz, stretch = expand(gx, gy, gz)
                if stretch == 0.0:
                    continue
            ox = middle[0] + radius * gx - centre[0]
            oy = middle[1] + radius * gy - centre[1]
            oz = middle[2] + radius * gz - centre[2]
            z = rotation[2, 0] * ox + rotation[2, 1] * oy + rotation[2, 2] * oz
            if z <= 0.0:
                continue
            x = rotation[0, 0] * ox + rotation[0, 1] * oy + rotation[0, 2] * oz
            y = rotation[1, 0] * ox + rotation[1, 1] * oy + rotation[1, 2] * oz
            u, v = fx * x / z + cx, fy * y / z + cy
            if not (u >= 0.0 and v >= 0.0 and u < width and v < height):
                continue
            band = truncation * voxel * radius * stretch
            distance, cosine = depth_at(distances, cosines, u, v, band)
            if distance <= 0.0:
                continue
            length = math.sqrt(ox * ox + oy * oy + oz * oz)
            along = distance - length
            if contracted and along < 0.0:
                # Behind a near surface the band is that of the surface, however coarse the voxels here.
                share = distance / length
                px = (centre[0] + share * ox - middle[0]) / radius
                py = (centre[1] + share * oy - middle[1]) / radius
                pz = (centre[2] + share * oz - middle[2]) / radius
                there = max(1.0, px * px + py * py + pz * pz)
                band = min(band, truncation * voxel * radius * there)
            if along < -band:
                continue
            value = along * cosine / band
            weight = max(cosine, MIN_WEIGHT)
            if along > band:
                # Free space: certain, but how far from the surface the voxel is remains unknown.
                value, weight = 1.0, FREE_WEIGHT
            total = weights[b, k] + weight
            values[b, k] += (value - values[b, k]) * (weight / total)
            weights[b, k] = total
