"""Rasterization of a texture layout: the triangle at each pixel."""

import math

import numpy as np
from jaxtyping import Float32, Float64, Int, Int32

from octasplat.engine.core.compilation import kernel


@kernel()
def rasterise(
    xy: Float64[np.ndarray, "v 2"],
    faces: Int[np.ndarray, "f 3"],
    owner: Int32[np.ndarray, "h w"],
    weights: Float32[np.ndarray, "h w 2"],
) -> None:
    """Write which triangle each pixel's centre lies in, and the weights of its second and third corner.

    Pixels that a triangle touches only with a part of their area, their centre being outside of every
    triangle, get the nearest point of it: bilinear look-ups reach them.
    """
    height, width = owner.shape
    # centers inside of triangles first, then pixels that one only touches
    for near in range(2):
        reach = 0.75 * near
        for f in range(len(faces)):
            ax, ay = xy[faces[f, 0], 0], xy[faces[f, 0], 1]
            bx, by = xy[faces[f, 1], 0] - ax, xy[faces[f, 1], 1] - ay
            cx, cy = xy[faces[f, 2], 0] - ax, xy[faces[f, 2], 1] - ay
            area = bx * cy - by * cx
            if area == 0.0:
                continue
            x0 = max(0, math.floor(ax + min(0.0, min(bx, cx)) - reach - 0.5))
            x1 = min(width - 1, math.ceil(ax + max(0.0, max(bx, cx)) + reach - 0.5))
            y0 = max(0, math.floor(ay + min(0.0, min(by, cy)) - reach - 0.5))
            y1 = min(height - 1, math.ceil(ay + max(0.0, max(by, cy)) + reach - 0.5))
            for row in range(y0, y1 + 1):
                for column in range(x0, x1 + 1):
                    if owner[row, column] >= 0:
                        continue
                    px, py = column + 0.5 - ax, row + 0.5 - ay
                    b, c = (px * cy - py * cx) / area, (bx * py - by * px) / area
                    if not (b >= 0.0 and c >= 0.0 and b + c <= 1.0):
                        if near == 0:
                            continue
                        # the nearest point, about: onto the edges by clamping
                        b, c = max(b, 0.0), max(c, 0.0)
                        if b + c > 1.0:
                            b, c = b / (b + c), c / (b + c)
                        dx, dy = px - b * bx - c * cx, py - b * by - c * cy
                        if dx * dx + dy * dy > reach * reach:
                            continue
                    owner[row, column] = f
                    weights[row, column, 0], weights[row, column, 1] = b, c
