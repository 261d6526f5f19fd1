"""Fuse depth maps into blocks of voxels.

First the blocks that a surface passes are found, then signed distances are averaged in them: "A Volumetric
Method for Building Complex Models from Range Images" (Curless and Levoy 1996). Space around the unit ball
may be
contracted: "Mip-NeRF 360: Unbounded Anti-Aliased Neural Radiance Fields" (Barron et al. 2022), Eq. 10.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8

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


class DepthView(NamedTuple):
    """A camera of depth maps: focal lengths and principal point, pixels, and its pose.

    ``rotation`` takes world to camera directions, ``centre`` is in world units.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    rotation: Float64[np.ndarray, "3 3"]
    centre: Float64[np.ndarray, "3"]


class VoxelGrid(NamedTuple):
    """Voxel grid from ``low`` on with spacing ``voxel``, in units of ``radius`` around ``middle``.

    With ``contracted`` space outside of the unit ball is contracted. ``truncation`` is in voxels.
    """

    low: Float64[np.ndarray, "3"]
    voxel: float
    contracted: bool
    middle: Float64[np.ndarray, "3"]
    radius: float
    truncation: float


@device_function()
def contract(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return the contracted position of a point in units of the unit ball."""
    length = math.sqrt(x * x + y * y + z * z)
    if length <= 1.0:
        return x, y, z
    factor = (2.0 - 1.0 / length) / length  # Eq. 10: (2 - 1/|x|) x/|x|
    return x * factor, y * factor, z * factor


@device_function()
def expand(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Invert :func:`contract`, and return its largest stretch of lengths (1 inside the ball).

    Points on and beyond the rim of contracted space, which stand for infinity, give a stretch of 0.
    """
    length = math.sqrt(x * x + y * y + z * z)
    if length <= 1.0:
        return x, y, z, 1.0
    if length >= 1.999:
        return x, y, z, 0.0
    world = 1.0 / (2.0 - length)  # the inverse: |x| = 1 / (2 - |y|)
    factor = world / length
    return x * factor, y * factor, z * factor, world * world  # d|x|/d|y| = |x|^2


@kernel()
def mark_blocks(
    first_row: int,
    last_row: int,
    distances: Float32[np.ndarray, "h w"],
    view: DepthView,
    grid: VoxelGrid,
    marks: UInt8[np.ndarray, "bx by bz"],
) -> None:
    """Set ``marks`` of the blocks within the truncation (along the ray) of a depth map's points.

    Takes the rows ``first_row`` to ``last_row``. Threads may set one mark twice, which is harmless.
    """
    fx, fy, cx, cy, rotation, centre = view
    low, voxel, contracted, middle, radius, truncation = grid
    width = distances.shape[1]
    nx, ny, nz = marks.shape
    for row in range(first_row, last_row):
        for column in range(width):
            distance = np.float64(distances[row, column])
            if distance <= 0.0 or not math.isfinite(distance):
                continue
            dx, dy = (column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy
            scale = 1.0 / math.sqrt(dx * dx + dy * dy + 1.0)
            wx = (rotation[0, 0] * dx + rotation[1, 0] * dy + rotation[2, 0]) * scale
            wy = (rotation[0, 1] * dx + rotation[1, 1] * dy + rotation[2, 1]) * scale
            wz = (rotation[0, 2] * dx + rotation[1, 2] * dy + rotation[2, 2]) * scale
            # --- the length of a voxel there ---
            step = voxel * radius
            if contracted:
                px = (centre[0] + wx * distance - middle[0]) / radius
                py = (centre[1] + wy * distance - middle[1]) / radius
                pz = (centre[2] + wz * distance - middle[2]) / radius
                # contraction shrinks radial lengths by |x|^2
                step *= max(1.0, px * px + py * py + pz * pz)
            # --- points along the ray, half a block apart ---
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
def depth_at(
    distances: Float32[np.ndarray, "h w"],
    cosines: Float32[np.ndarray, "h w"],
    u: float,
    v: float,
    jump: float,
) -> tuple[float, float]:
    """Return distance and cosine at an image point: bilinear on one surface, else of the pixel itself.

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
    if not (least > 0.0 and most - least <= jump):  # a zero is an unknown pixel
        return nearest, cosine
    tx, ty = u - 0.5 - x0, v - 0.5 - y0
    return (a * (1 - tx) + b * tx) * (1 - ty) + (c * (1 - tx) + d * tx) * ty, cosine


@kernel()
def tile_ranges(
    distances: Float32[np.ndarray, "h w"],
    nearest: Float32[np.ndarray, "th tw"],
    farthest: Float32[np.ndarray, "th tw"],
) -> None:
    """Return the smallest and largest distance in each tile of 16 x 16 pixels; unknown ones count as 0."""
    height, width = distances.shape
    nearest[:], farthest[:] = np.inf, 0.0
    for row in range(height):
        for column in range(width):
            y, x = row // TILE, column // TILE
            nearest[y, x] = min(nearest[y, x], distances[row, column])
            farthest[y, x] = max(farthest[y, x], distances[row, column])


@device_function()
def classify_block(
    offset: tuple[float, float, float],
    half: float,
    band: float,
    view: DepthView,
    width: int,
    height: int,
    nearest: Float32[np.ndarray, "th tw"],
    farthest: Float32[np.ndarray, "th tw"],
) -> int:
    """Return ``BLOCK_BEHIND``, ``BLOCK_IN_FRONT`` or ``BLOCK_NEAR`` for a block.

    ``offset`` leads from the camera to its centre, and ``half`` is the radius of a ball around it.
    """
    fx, fy, cx, cy, rotation, _centre = view
    ox, oy, oz = offset
    z = rotation[2, 0] * ox + rotation[2, 1] * oy + rotation[2, 2] * oz
    if z + half <= 0.0:
        return BLOCK_BEHIND
    if z - half <= 0.1 * half:  # the camera is inside or close: no bounds on the image
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


class DepthMap(NamedTuple):
    """A depth map: distances along rays, cosines of surfaces to them, and the range in each tile."""

    distances: Float32[np.ndarray, "h w"]
    cosines: Float32[np.ndarray, "h w"]
    nearest: Float32[np.ndarray, "th tw"]
    farthest: Float32[np.ndarray, "th tw"]


@device_function()
def surface_band(
    share: float,
    offset: tuple[float, float, float],
    band: float,
    centre: Float64[np.ndarray, "3"],
    grid: VoxelGrid,
) -> float:
    """Return the truncation behind a near surface: that of the surface, however coarse the voxels here.

    The surface lies at ``share`` of the ``offset`` from the camera; ``band`` is the truncation at the voxel.
    """
    middle, radius = grid.middle, grid.radius
    px = (centre[0] + share * offset[0] - middle[0]) / radius
    py = (centre[1] + share * offset[1] - middle[1]) / radius
    pz = (centre[2] + share * offset[2] - middle[2]) / radius
    there = max(1.0, px * px + py * py + pz * pz)
    return min(band, grid.truncation * grid.voxel * radius * there)


@kernel()
def fuse_view(
    first: int,
    last: int,
    maps: DepthMap,
    view: DepthView,
    grid: VoxelGrid,
    blocks: Int32[np.ndarray, "b 3"],
    values: Float32[np.ndarray, "b 512"],
    weights: Float32[np.ndarray, "b 512"],
) -> None:
    """Add one depth map to the running means of signed distances, in units of the truncation.

    Takes the blocks ``first`` to ``last``. Positive in front of the surface, negative behind. The distance
    along the ray times the cosine is the distance to the tangent plane; the weight is the cosine too, as
    oblique depths are the less certain.
    """
    distances, cosines, nearest, farthest = maps
    fx, fy, cx, cy, rotation, centre = view
    low, voxel, contracted, middle, radius, truncation = grid
    height, width = distances.shape
    for b in range(first, last):
        base_x, base_y, base_z = blocks[b, 0] * BLOCK, blocks[b, 1] * BLOCK, blocks[b, 2] * BLOCK
        if not contracted:
            # --- blocks that the map tells nothing or one thing of ---
            offset = (
                low[0] + (base_x + 0.5 * BLOCK) * voxel - centre[0],
                low[1] + (base_y + 0.5 * BLOCK) * voxel - centre[1],
                low[2] + (base_z + 0.5 * BLOCK) * voxel - centre[2],
            )
            half = 0.5 * BLOCK * voxel * math.sqrt(3.0)
            lies = classify_block(offset, half, truncation * voxel, view, width, height, nearest, farthest)
            if lies == BLOCK_BEHIND:
                continue
            if lies == BLOCK_IN_FRONT:
                for k in range(VOXELS_PER_BLOCK):
                    total = weights[b, k] + FREE_WEIGHT
                    values[b, k] += (1.0 - values[b, k]) * (FREE_WEIGHT / total)
                    weights[b, k] = total  # running mean
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
            # --- the signed distance along the ray ---
            length = math.sqrt(ox * ox + oy * oy + oz * oz)
            along = distance - length
            if contracted and along < 0.0:
                band = surface_band(distance / length, (ox, oy, oz), band, centre, grid)
            if along < -band:
                continue  # hidden: nothing is known behind the surface
            value = along * cosine / band
            weight = max(cosine, MIN_WEIGHT)
            if along > band:
                # Free space: certain, but how far from the surface the voxel is remains unknown.
                value, weight = 1.0, FREE_WEIGHT
            total = weights[b, k] + weight
            values[b, k] += (value - values[b, k]) * (weight / total)
            weights[b, k] = total
