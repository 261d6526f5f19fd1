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
    offsets = [((k + 0.5) / side - 0.5) for k in range(side)]
    for number, (down, across) in enumerate(product(offsets, offsets)):
        part(number / side**2)
        found = render_rays(tracer, image.shifted(across, down), background_colour("black"), shading)
        light += found.alpha[..., None] * found.layers[LINEAR]
        coverage += found.alpha
    linear = light / np.maximum(coverage, 1e-6)[..., None]
    return PixelMeans(linear.astype(np.float32), (coverage / side**2).astype(np.float32))


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
