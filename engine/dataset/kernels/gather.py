"""Kernels that gather pixels and rays from the mapped planes and ray tables."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt, UInt8

from octasplat.engine.core.compilation import device_function, kernel


class PixelIndices(NamedTuple):
    """Pixels of views: the view, row and column of each."""

    view: Int64[np.ndarray, " n"]
    y: Int64[np.ndarray, " n"]
    x: Int64[np.ndarray, " n"]


class ViewArrays(NamedTuple):
    """Views of a dataset.

    Attributes:
        sizes: width and height of each.
        cameras: camera of each.
        camera_tables: first pixel of each camera's table of directions, -1 for a pinhole, -2 for neither.
        table: camera-frame directions of all tables; not a number where a pixel has no ray.
    """

    sizes: Int64[np.ndarray, "v 2"]
    cameras: Int64[np.ndarray, " v"]
    camera_tables: Int64[np.ndarray, " c"]
    table: Float32[np.ndarray, " t"]


class PixelPlanes(NamedTuple):
    """Photographs and masks of all views, one view after another.

    Attributes:
        offsets: first pixel of each view.
        rgb: colors.
        rgb_full: the value of full brightness.
        alpha: alpha, or empty.
        mask: masks, or empty.
        mask_is_alpha: whether the mask multiplies alpha instead of deciding the weight.
    """

    offsets: Int64[np.ndarray, " v"]
    rgb: UInt[np.ndarray, " p3"]
    rgb_full: np.float32
    alpha: UInt8[np.ndarray, " p"]
    mask: UInt8[np.ndarray, " p"]
    mask_is_alpha: bool


@device_function()
def _is_pixel(sizes: Int64[np.ndarray, "v 2"], view: int, y: int, x: int) -> bool:
    """Return whether there is such a view, and it has the pixel."""
    return 0 <= view < sizes.shape[0] and 0 <= x < sizes[view, 0] and 0 <= y < sizes[view, 1]


@kernel()
def gather_rays(
    pixels: PixelIndices,
    views: ViewArrays,
    rotations_world_from_cam: Float64[np.ndarray, "v 3 3"],
    origins_world: Float32[np.ndarray, "v 3"],
    camera_pinhole: Float64[np.ndarray, "c 4"],
    origins: Float32[np.ndarray, "n 3"],
    directions: Float32[np.ndarray, "n 3"],
) -> int:
    """Write the world rays of pixels to ``origins`` and ``directions``.

    Args:
        pixels: the pixels.
        views: what they belong to.
        rotations_world_from_cam: of the views.
        origins_world: centres of their cameras.
        camera_pinhole: fx, fy, cx, cy of each camera; used where it is a pinhole.
        origins: receives the ray origins.
        directions: receives unit directions. Pixels without a ray, and those of cameras with neither
            formula nor table, look along the axis of the camera.

    Returns:
        The first index whose pixel does not exist, or -1.
    """
    view, y, x = pixels
    view_size, view_camera, camera_table, table = views
    for i in range(view.shape[0]):
        v = view[i]
        if not _is_pixel(view_size, v, y[i], x[i]):
            return i
        camera = view_camera[v]
        dx, dy, dz = 0.0, 0.0, 1.0
        if camera_table[camera] == -1:
            dx = (x[i] + 0.5 - camera_pinhole[camera, 2]) / camera_pinhole[camera, 0]
            dy = (y[i] + 0.5 - camera_pinhole[camera, 3]) / camera_pinhole[camera, 1]
        elif camera_table[camera] >= 0:
            first = 3 * (camera_table[camera] + y[i] * view_size[v, 0] + x[i])
            # All three numbers of a direction are not-a-number, or none is.
            if not math.isnan(table[first]):
                dx, dy, dz = (
                    np.float64(table[first]),
                    np.float64(table[first + 1]),
                    np.float64(table[first + 2]),
                )
        norm = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
        for k in range(3):
            origins[i, k] = origins_world[v, k]
            directions[i, k] = norm * (
                rotations_world_from_cam[v, k, 0] * dx
                + rotations_world_from_cam[v, k, 1] * dy
                + rotations_world_from_cam[v, k, 2] * dz
            )
    return -1


@kernel()
def gather_pixels(
    pixels: PixelIndices,
    views: ViewArrays,
    planes: PixelPlanes,
    rgb_out: Float32[np.ndarray, "n 3"],
    alpha_out: Float32[np.ndarray, " n"],
    weight_out: Float32[np.ndarray, " n"],
) -> int:
    """Write colors, alpha and weights of pixels.

    Args:
        pixels: the pixels.
        views: what they belong to.
        planes: the photographs.
        rgb_out: receives display colors in [0, 1].
        alpha_out: receives alpha in [0, 1].
        weight_out: receives 1, or 0 where the pixel does not count.

    Returns:
        The first index whose pixel does not exist, or -1.
    """
    view, y, x = pixels
    view_size, view_camera, camera_table, table = views
    view_offset, rgb, rgb_full, alpha, mask, mask_is_alpha = planes
    byte = np.float32(255.0)
    one = np.float32(1.0)
    zero = np.float32(0.0)
    for i in range(view.shape[0]):
        v = view[i]
        if not _is_pixel(view_size, v, y[i], x[i]):
            return i
        inside = y[i] * view_size[v, 0] + x[i]
        pixel = view_offset[v] + inside
        for k in range(3):
            rgb_out[i, k] = np.float32(rgb[3 * pixel + k]) / rgb_full
        coverage = one
        weight = one
        if alpha.shape[0] > 0:
            coverage = np.float32(alpha[pixel]) / byte
        if mask.shape[0] > 0:
            if mask_is_alpha:
                coverage *= np.float32(mask[pixel]) / byte
            elif mask[pixel] < 128:
                weight = zero
        first = camera_table[view_camera[v]]
        if first >= 0 and math.isnan(table[3 * (first + inside)]):
            weight = zero
        alpha_out[i] = coverage
        weight_out[i] = weight
    return -1
