"""Pictures of what is sharper than a pixel: several rays through each, their light averaged."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float32

from engine.colour import linear_to_srgb
from engine.rays import ImageRays
from engine.render.renderer import RenderedImage, background_colour, render_rays
from engine.shading.protocol import ShadingModel
from engine.trace.protocol import Tracer

MOST_ACROSS = 4
"""More rays than 16 a pixel are not worth their time."""
LINEAR = "linear"
"""The layer of a shading model that holds radiance."""


@dataclass(frozen=True)
class PixelMeans:
    """Means over the rays of each pixel.

    Attributes:
        linear: radiance of what is there.
        alpha: share of the pixel that is covered.
    """

    linear: Float32[np.ndarray, "h w 3"]
    alpha: Float32[np.ndarray, "h w"]


def pixel_means(
    tracer: Tracer,
    image: ImageRays,
    shading: ShadingModel,
    side: int,
    part: Callable[[float], None] = lambda _share: None,
) -> PixelMeans:
    """Trace ``side`` x ``side`` rays a pixel, evenly spread, through a scene whose shading gives radiance.

    Args:
        tracer: built around the Gaussians.
        image: rays through the centres of the pixels.
        shading: a model with the layer ``linear``.
        side: so many rays across a pixel, and as many down.
        part: told the share that is done.
    """
    light = np.zeros((image.height_px, image.width_px, 3))
    coverage = np.zeros((image.height_px, image.width_px))
    for number, (across, down) in enumerate(_offsets(side)):
        part(number / side**2)
        shifted = image.shifted(across, down)
        found = render_rays(tracer, shifted, background_colour("black"), shading, number)
        light += found.alpha[..., None] * found.layers[LINEAR]
        coverage += found.alpha
    linear = light / np.maximum(coverage, 1e-6)[..., None]
    return PixelMeans(linear.astype(np.float32), (coverage / side**2).astype(np.float32))


def pixel_rad(image: ImageRays) -> float:
    """The angle of a pixel in the middle of an image, from its centre to its neighbour's; 0 of one pixel."""
    ways = image.directions_world.astype(np.float64)
    row, column = image.height_px // 2, image.width_px // 2
    if image.width_px > 1:
        pair = ways[row, column - 1], ways[row, column]
    elif image.height_px > 1:
        pair = ways[row - 1, column], ways[row, column]
    else:
        return 0.0
    return float(np.linalg.norm(np.cross(*pair)))


def rays_across(image: ImageRays, trained_rad: float) -> int:
    """So many rays across a pixel that they lie about as close as the training's, ``MOST_ACROSS`` at most.

    Args:
        image: rays through the centres of the pixels.
        trained_rad: angle of a pixel of the training views; 0 where it is not known, which makes it one ray.
    """
    if trained_rad <= 0:
        return 1
    return min(MOST_ACROSS, max(1, round(pixel_rad(image) / trained_rad)))


def render_averaged(
    tracer: Tracer,
    image: ImageRays,
    background_srgb: Float32[np.ndarray, "3"],
    shading: ShadingModel,
    side: int,
) -> RenderedImage:
    """An image whose display colours and alpha are means over ``side`` x ``side`` rays a pixel.

    That is what making a larger picture smaller gives. Everything else is that of the pixels' centres.
    """
    centre = render_rays(tracer, image, background_srgb, shading, side**2 // 2)
    if side == 1:
        return centre
    rgb, alpha = np.zeros(centre.rgb_srgb.shape), np.zeros(centre.alpha.shape)
    for number, (across, down) in enumerate(_offsets(side)):
        shifted = image.shifted(across, down)
        found = centre if shifted is image else render_rays(tracer, shifted, background_srgb, shading, number)
        rgb += found.rgb_srgb
        alpha += found.alpha
    rays = side**2
    return replace(centre, rgb_srgb=(rgb / rays).astype(np.float32), alpha=(alpha / rays).astype(np.float32))


def render_filtered(
    tracer: Tracer,
    image: ImageRays,
    background: Float32[np.ndarray, "3"],
    shading: ShadingModel,
    side: int,
) -> RenderedImage:
    """An image whose colours and alpha are those that a photograph's pixels collect.

    Everything else is that of the centres of the pixels.
    """
    centre = render_rays(tracer, image, background, shading)
    if LINEAR not in centre.layers:
        return centre
    means = pixel_means(tracer, image, shading, side)
    alpha = means.alpha[..., None]
    rgb = linear_to_srgb(np.minimum(means.linear, 1.0)) * alpha + (1 - alpha) * background
    return replace(centre, rgb_srgb=rgb.astype(np.float32), alpha=means.alpha)


def _offsets(side: int) -> list[tuple[float, float]]:
    """Places of ``side`` x ``side`` rays in a pixel, across and down from its centre, row by row."""
    steps = [((k + 0.5) / side - 0.5) for k in range(side)]
    return [(across, down) for down, across in product(steps, steps)]
