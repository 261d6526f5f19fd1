"""Depth maps and colors of a scene, rendered by the tracer into a temporary file."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from octasplat.engine.core.color import to_bytes
from octasplat.engine.core.file_arrays import new_array
from octasplat.engine.core.rays import ImageRays
from octasplat.engine.render.pinhole_camera import PinholeCamera
from octasplat.engine.render.renderer import RenderedImage, render_rays
from octasplat.engine.surface.color_fit import Picture
from octasplat.engine.surface.options import ExtractionOptions
from octasplat.engine.trace.protocol import Tracer

Progress = Callable[[int, int], None]
EMPTY_ALPHA = 0.05
"""Pixels that the scene covers less than this are empty: all space before them is free."""
EMPTY_DEPTH = np.float32(np.inf)
UNKNOWN_DEPTH = np.float32(0.0)


@dataclass(frozen=True)
class DepthMaps:
    """Depths as seen by each camera; the images may differ in size.

    Attributes:
        cameras: the cameras.
        distances: for each, distances along the unit rays in world units; 0 where nothing is known, infinite
            where the ray is free.
        cosines: for each, cosines of the angles between rays and surface normals.
    """

    cameras: tuple[PinholeCamera, ...]
    distances: tuple[Float32[np.ndarray, "_h _w"], ...]
    cosines: tuple[Float32[np.ndarray, "_h _w"], ...]


def render_depth_maps(
    tracer: Tracer,
    cameras: Sequence[PinholeCamera],
    options: ExtractionOptions,
    folder: Path,
    progress: Progress = lambda _done, _total: None,
) -> tuple[DepthMaps, tuple[Picture, ...]]:
    """Render depth maps and colors from ``cameras`` into a file in ``folder``, 12 bytes per pixel.

    The file has no name, so that nothing is left of it whatever happens.

    Raises:
        DiskFullError: there is no room for it.
    """
    sizes = [camera.width_px * camera.height_px for camera in cameras]
    stored = new_array((3 * sum(sizes),), np.float32, folder)
    distances, cosines, colors, start = [], [], [], 0
    black = np.zeros(3, np.float32)
    progress(0, len(cameras))
    for number, (camera, size) in enumerate(zip(cameras, sizes, strict=True)):
        shape = (camera.height_px, camera.width_px)
        distances.append(stored[start : start + size].reshape(shape))
        cosines.append(stored[start + size : start + 2 * size].reshape(shape))
        colors.append(stored[start + 2 * size : start + 3 * size].view(np.uint8).reshape(*shape, 4))
        start += 3 * size
        rays = camera.rays()
        image = render_rays(tracer, rays, black)
        distances[-1][...] = _depth_values(image, options)
        # The tracer turns normals to the viewer, so the dot product is negative.
        cosines[-1][...] = np.clip(-np.sum(image.normal_world * rays.directions_world, axis=-1), 0.0, 1.0)
        colors[-1][...] = to_bytes(np.concatenate([image.rgb_srgb, image.alpha[..., None]], axis=2))
        progress(number + 1, len(cameras))
    maps = DepthMaps(tuple(cameras), tuple(distances), tuple(cosines))
    return maps, tuple(partial(_stored_image, *pair) for pair in zip(cameras, colors, strict=True))


def _stored_image(
    camera: PinholeCamera, stored: UInt8[np.ndarray, "h w 4"]
) -> tuple[ImageRays, UInt8[np.ndarray, "h w 4"]]:
    return camera.rays(), np.asarray(stored)


def _depth_values(image: RenderedImage, options: ExtractionOptions) -> Float32[np.ndarray, "h w"]:
    distances = image.depth_median if options.depth_mode == "median" else image.depth
    distances = np.where(image.alpha >= options.min_alpha, distances, UNKNOWN_DEPTH)
    distances[image.alpha < EMPTY_ALPHA] = EMPTY_DEPTH  # in this order: empty overrides unknown
    if options.depth_trunc is not None:
        distances[(distances > options.depth_trunc) & (distances < EMPTY_DEPTH)] = UNKNOWN_DEPTH
    return distances
