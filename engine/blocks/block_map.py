"""Map of a scene in blocks: its points from above, a color a block, and the cameras."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from octasplat.engine.blocks.partition import Box, weighted_spread
from octasplat.engine.dataset.model import DatasetModel
from octasplat.engine.render.upright import estimate_up

SIDE_PX, BORDER_PX = 800, 20


@dataclass(frozen=True, eq=False)
class BlockMap:
    """A map of blocks.

    Attributes:
        image_srgb: a square picture, display colors.
        middles: of the points in each block, from the left and the top, 0 to 1; of a block without points the
            middle of the picture.
    """

    image_srgb: Float32[np.ndarray, "s s 3"]
    middles: Float64[np.ndarray, "b 2"]


def draw_block_map(model: DatasetModel, cores: Sequence[Box]) -> BlockMap:
    """Draw the points of a model along the axis of least spread, a color a block, cameras black.

    They are seen from above, or a wall from the side of its cameras and upright.

    Args:
        model: views and points.
        cores: boxes of the blocks.
    """
    points = model.points.xyz_world.astype(np.float64)
    weights = np.maximum(model.points.track_lengths, 1).astype(np.float64)
    cameras = np.stack([view.origin_world for view in model.views])
    up = estimate_up(np.stack([view.rotation_cam_from_world for view in model.views]))
    side = np.median(cameras, axis=0) - np.median(points, axis=0)
    to_picture = _picture_axes(int(np.argmin(weighted_spread(points, weights))), up, side)
    points_xy, cameras_xy = points @ to_picture.T, cameras @ to_picture.T
    # most of the points and most of the cameras, whichever reach farther
    ranges = [np.quantile(places, [0.02, 0.98], axis=0) for places in (cameras_xy, points_xy)]
    low, high = np.minimum(ranges[0][0], ranges[1][0]), np.maximum(ranges[0][1], ranges[1][1])
    scale = (SIDE_PX - 2 * BORDER_PX) / max(float((high - low).max()), 1e-12)
    corner = (low + high) / 2 - SIDE_PX / 2 / scale
    image = np.ones((SIDE_PX, SIDE_PX, 3), np.float32)
    middles = np.full((len(cores), 2), 0.5)
    for number, core in enumerate(cores):
        xy_px = (points_xy[core.contains(points)] - corner) * scale
        _draw_dots(image, xy_px, _color(number), 1)
        if len(xy_px):
            middles[number] = np.clip(np.median(xy_px, axis=0) / SIDE_PX, 0.0, 1.0)
    _draw_dots(image, (cameras_xy - corner) * scale, np.zeros(3), 2)
    return BlockMap(image, middles)


def _picture_axes(
    along: int, up: Float64[np.ndarray, "3"], side: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "2 3"]:
    """Return the world's axes that are right and down in a picture which is not mirrored, as rows.

    Args:
        along: axis along which it is looked.
        up: against gravity.
        side: from what is seen to those who see it.
    """
    across, other = (np.eye(3)[axis] for axis in range(3) if axis != along)
    viewer = np.eye(3)[along]
    if abs(up[along]) > 0.5:
        viewer = viewer * np.sign(up[along])
        return np.stack([across, np.cross(across, viewer)])
    viewer = viewer * (-1 if side[along] < 0 else 1)
    upright = max((across, other), key=lambda axis: abs(float(up @ axis)))
    down = -upright * np.sign(up @ upright)
    return np.stack([np.cross(viewer, down), down])


def _draw_dots(
    image: Float32[np.ndarray, "h w 3"], xy_px: Float64[np.ndarray, "n 2"], color: np.ndarray, radius: int
) -> None:
    """Draw squares of ``2 radius - 1`` pixels a side, those outside of the picture left out."""
    height, width = image.shape[:2]
    column, row = np.rint(xy_px).astype(np.int64).T
    for down in range(1 - radius, radius):
        for right in range(1 - radius, radius):
            y, x = row + down, column + right
            inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
            image[y[inside], x[inside]] = color


def _color(number: int) -> Float64[np.ndarray, "3"]:
    """Return a color that differs from those of the numbers before: hues at steps of the golden section."""
    hue = number * 0.618034 % 1.0
    wave = np.abs((hue * 6 + np.array([0.0, 4.0, 2.0])) % 6 - 3) - 1
    return 0.15 + 0.75 * np.clip(wave, 0, 1)
