"""Compiled gathers over the mapped pixels and ray tables."""

import math
from typing import Any

import numpy as np

from octasplat.engine.core.compilation import kernel


@kernel()
def gather_rays(
    view: Any,
    y: Any,
    x: Any,
    view_size: Any,
    view_camera: Any,
    rotations_world_from_cam: Any,
    origins_world: Any,
    camera_pinhole: Any,
    camera_table: Any,
    table: Any,
    origins: Any,
    directions: Any,
) -> int:
    """Write the world rays of n pixels to ``origins`` and ``directions``, both (n, 3) float32.

    Args:
        view: view of each pixel, (n,) int64.
        y: row of each pixel, (n,) int64.
        x: column of each pixel, (n,) int64.
        view_size: width and height of each view, (v, 2) int64.
        view_camera: camera of each view, (v,) int64.
        rotations_world_from_cam: (v, 3, 3) float64.
        origins_world: (v, 3) float32.
        camera_pinhole: fx, fy, cx, cy of each camera, (c, 4) float64; used where it is a pinhole.
        camera_table: first pixel of each camera's table, -1 for a pinhole, -2 for neither, (c,) int64.
        table: camera-frame directions, flat float32.
        origins: receives the ray origins.
        directions: receives unit directions. Pixels without a ray, and those of cameras with neither
            formula nor table, look along the axis of the camera.

    Returns:
        The first index whose pixel does not exist, or -1.
    """
    for i in range(view.shape[0]):
        v = view[i]
        if (
            v < 0
            or v >= view_size.shape[0]
            or not (0 <= x[i] < view_size[v, 0] and 0 <= y[i] < view_size[v, 1])
        ):
            return i
        camera = view_camera[v]
        dx, dy, dz = 0.0, 0.0, 1.0
        if camera_table[camera] == -1:
            dx = (x[i] + 0.5 - camera_pinhole[camera, 2]) / camera_pinhole[camera, 0]
            dy = (y[i] + 0.5 - camera_pinhole[camera, 3]) / camera_pinhole[camera, 1]
        elif camera_table[camera] >= 0:
            first = 3 * (camera_table[camera] + y[i] * view_size[v, 0] + x[i])
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
    view: Any,
    y: Any,
    x: Any,
    view_size: Any,
    view_camera: Any,
    view_offset: Any,
    camera_table: Any,
    table: Any,
    rgb: Any,
    rgb_full: Any,
    alpha: Any,
    mask: Any,
    mask_is_alpha: Any,
    rgb_out: Any,
    alpha_out: Any,
    weight_out: Any,
) -> int:
    """Write colours (n, 3), alpha (n,) and weights (n,) of n pixels to the three last arguments.

    Args:
        view: view of each pixel, (n,) int64.
        y: row of each pixel, (n,) int64.
        x: column of each pixel, (n,) int64.
        view_size: width and height of each view, (v, 2) int64.
        view_camera: camera of each view, (v,) int64.
        view_offset: first pixel of each view in the planes, int64.
        camera_table: see :func:`gather_rays`.
        table: see :func:`gather_rays`.
        rgb: colours of all views, flat uint8 or uint16.
        rgb_full: the value of full brightness, float32.
        alpha: alpha of all views, flat uint8, or empty.
        mask: masks of all views, flat uint8, or empty.
        mask_is_alpha: whether the mask multiplies alpha instead of deciding the weight.
        rgb_out: receives display colours in [0, 1].
        alpha_out: receives alpha in [0, 1].
        weight_out: receives 1, or 0 where the pixel does not count.

    Returns:
        The first index whose pixel does not exist, or -1.
    """
    byte = np.float32(255.0)
    one = np.float32(1.0)
    zero = np.float32(0.0)
    for i in range(view.shape[0]):
        v = view[i]
        if (
            v < 0
            or v >= view_size.shape[0]
            or not (0 <= x[i] < view_size[v, 0] and 0 <= y[i] < view_size[v, 1])
        ):
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
