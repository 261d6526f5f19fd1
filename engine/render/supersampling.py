"""Supersampling: several rays per pixel, averaged in linear light or in display values."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.core.rays import ImageRays
from octasplat.engine.render.renderer import (
    RenderedImage,
    background_color,
    render_rays,
    shade_layer,
    tile_order,
)
from octasplat.engine.shading.protocol import LINEAR, ShadingModel
from octasplat.engine.trace.protocol import Tracer

MAX_RAYS_PER_SIDE = 4
"""More rays than 16 a pixel are not worth their time."""
UNEVEN_RATIO = 0.1
"""Display values of a pixel's rays that are further apart than this are asked for more of them."""
RADIANCE_RAYS_PER_SIDE = 2
"""Rays across a pixel, and as many down, of pictures whose shading gives radiance."""


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
    """Trace ``side`` x ``side`` rays per pixel, evenly spread, through a scene whose shading gives radiance.

    Where these differ, at edges and where facets are drawn, as many again across and down take their place.

    Args:
        tracer: built around the Gaussians.
        image: rays through the centres of the pixels.
        shading: a model with the layer ``linear``.
        side: so many rays across a pixel, and as many down.
        part: called with the share that is done.
    """
    size = image.height_px, image.width_px
    light, coverage = np.zeros((*size, 3)), np.zeros(size)
    lowest, highest = np.full((*size, 3), np.inf, np.float32), np.zeros((*size, 3), np.float32)
    for number, (across, down) in enumerate(_subpixel_offsets(side)):
        part(number / (2 * side**2))
        found = render_rays(tracer, image.shifted(across, down), background_color("black"), shading, number)
        light += found.alpha[..., None] * found.layers[LINEAR] / side**2
        coverage += found.alpha / side**2
        np.minimum(lowest, found.rgb_srgb, out=lowest)
        np.maximum(highest, found.rgb_srgb, out=highest)
    finer = min(2 * side, MAX_RAYS_PER_SIDE)  # twice as fine where rays differ, but not beyond the most
    order = tile_order(*size)
    uneven = order[((highest - lowest).max(axis=2) > UNEVEN_RATIO).reshape(-1)[order]]
    if finer > side and len(uneven):
        light.reshape(-1, 3)[uneven], coverage.reshape(-1)[uneven] = 0, 0
        for number, (across, down) in enumerate(_subpixel_offsets(finer)):
            part(0.5 + number / (2 * finer**2))
            # sample numbers go on, so that no dither comes twice
            shifted, sample = image.shifted(across, down), side**2 + number
            linear, alpha = shade_layer(
                tracer=tracer, image=shifted, pixels=uneven, shading=shading, layer=LINEAR, sample=sample
            )
            light.reshape(-1, 3)[uneven] += alpha[:, None] * linear / finer**2
            coverage.reshape(-1)[uneven] += alpha / finer**2
    mean = light / np.maximum(coverage, 1e-6)[..., None]
    return PixelMeans(mean.astype(np.float32), coverage.astype(np.float32))


def pixel_angle(image: ImageRays) -> float:
    """Return the angle of an image's central pixel, to its neighbour's centre; 0 for a single pixel."""
    ways = image.directions_world.astype(np.float64)
    row, column = image.height_px // 2, image.width_px // 2
    if image.width_px > 1:
        pair = ways[row, column - 1], ways[row, column]
    elif image.height_px > 1:
        pair = ways[row - 1, column], ways[row, column]
    else:
        return 0.0
    return float(np.linalg.norm(np.cross(*pair)))  # the sine of a small angle


def rays_per_pixel_side(image: ImageRays, trained_rad: float) -> int:
    """Return the rays across a pixel at the training's spacing, ``MAX_RAYS_PER_SIDE`` at most.

    Args:
        image: rays through the centres of the pixels.
        trained_rad: angle of a pixel of the training views; 0 where it is not known, which makes it one ray.
    """
    if trained_rad <= 0:
        return 1
    return min(MAX_RAYS_PER_SIDE, max(1, round(pixel_angle(image) / trained_rad)))


def render_averaged(
    tracer: Tracer,
    image: ImageRays,
    background_srgb: Float32[np.ndarray, "3"],
    shading: ShadingModel,
    side: int,
) -> RenderedImage:
    """Return an image whose display colors and alpha are means over ``side`` x ``side`` rays per pixel.

    That is what making a larger picture smaller gives. Everything else is that of the pixels' centres.
    """
    centre = render_rays(tracer, image, background_srgb, shading, side**2 // 2)
    if side == 1:
        return centre
    rgb, alpha = np.zeros(centre.rgb_srgb.shape), np.zeros(centre.alpha.shape)
    for number, (across, down) in enumerate(_subpixel_offsets(side)):
        shifted = image.shifted(across, down)
        # the center's ray is not traced twice
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
    *,
    max_radiance: float = 1.0,
) -> RenderedImage:
    """Return an image whose colors and alpha are filtered as a photograph's pixels collect them.

    Everything else is that of the centres of the pixels.

    Args:
        tracer: built around the Gaussians, with what ``shading`` blends of them.
        image: rays through the centres of the pixels.
        background: display color behind the scene.
        shading: what develops the rays; one that gives no radiance is shown by the centres alone.
        side: so many rays across a pixel, and as many down.
        max_radiance: where a pixel's radiance is cut off: at white, as in a photograph, or infinity.
    """
    centre = render_rays(tracer, image, background, shading)
    if LINEAR not in centre.layers:
        return centre
    means = pixel_means(tracer, image, shading, side)
    alpha = means.alpha[..., None]
    # clipped before the blend, as a photograph's pixel is
    display = linear_to_srgb(np.minimum(means.linear, np.float32(max_radiance)))
    rgb = display * alpha + (1 - alpha) * background
    return replace(centre, rgb_srgb=rgb.astype(np.float32), alpha=means.alpha)


def _subpixel_offsets(side: int) -> list[tuple[float, float]]:
    """Return places of ``side`` x ``side`` rays in a pixel, across and down from its centre, row by row."""
    steps = [((k + 0.5) / side - 0.5) for k in range(side)]
    return [(across, down) for down, across in product(steps, steps)]
