"""Full images from a tracer, in bands of rows."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64

from octasplat.engine.core.hashing import hashed_uniforms
from octasplat.engine.core.rays import ImageRays, RayBatch
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.shading.plain import PLAIN_SHADING
from octasplat.engine.shading.protocol import ShadingModel, TracedRays
from octasplat.engine.trace import ray_hits
from octasplat.engine.trace.facing_normals import face_viewer
from octasplat.engine.trace.protocol import RECORDED_RAYS_PER_BATCH, Tracer

RAYS_PER_BATCH = 1 << 18
FRONT_DEPTH_TOLERANCE = 0.005
"""What lies farther behind the median depth than this share of it is another surface."""
STEPS = np.array([0.7548776662466927, 0.5698402909980532])
"""One over the plastic number, and that squared."""
TILE_SIZE = 8
"""Rays go to the tracer in tiles of this side, so that neighbours are traced together."""


@dataclass(frozen=True)
class RenderedImage:
    """One rendered image.

    Attributes:
        rgb_srgb: display values over the background, clipped to [0, 1].
        alpha: accumulated alpha.
        depth: expected distance along the ray, world units; 0 where nothing was met.
        depth_median: distance at which half of the light is gone, 0 where it never is.
        normal_world: mean normal, turned to the viewer and of unit length; 0 where nothing was met.
        layers: what else the shading model shows, by name.
    """

    rgb_srgb: Float32[np.ndarray, "h w 3"]
    alpha: Float32[np.ndarray, "h w"]
    depth: Float32[np.ndarray, "h w"]
    depth_median: Float32[np.ndarray, "h w"]
    normal_world: Float32[np.ndarray, "h w 3"]
    layers: Mapping[str, Float32[np.ndarray, "h w _"]]


def render_rays(
    tracer: Tracer,
    image: ImageRays,
    background: Float32[np.ndarray, "3"],
    shading: ShadingModel = PLAIN_SHADING,
    sample: int = 0,
) -> RenderedImage:
    """Trace and shade an image; directions have unit length.

    Where ``shading`` has features, ``tracer`` must have been built with them. ``sample`` numbers pictures of
    which the mean will be taken, so that what the model draws at random is evenly spread over them.
    """
    height, width = image.height_px, image.width_px
    layers: dict[str, Float32[np.ndarray, "h w _"]] = {}
    out = RenderedImage(
        rgb_srgb=np.empty((height, width, 3), np.float32),
        alpha=np.empty((height, width), np.float32),
        depth=np.empty((height, width), np.float32),
        depth_median=np.empty((height, width), np.float32),
        normal_world=np.empty((height, width, 3), np.float32),
        layers=layers,
    )
    for band, order, rays in _row_bands(image):
        traced = tracer.trace(rays)
        # by the pixel in the whole image, so that bands change nothing
        dither = pixel_jitter(band.start * width + order, sample)
        shaded = shading.shade(TracedRays(rays, traced, tracer, dither=dither))
        rgb = shaded.composite_over(background)
        for name, values in shaded.layers.items():
            layers.setdefault(name, np.empty((height, width, values.shape[1]), np.float32))
        for part, values in (
            (out.rgb_srgb, np.clip(rgb, 0, 1)),
            (out.alpha, traced.alpha),
            (out.depth, traced.expected_depth),
            (out.depth_median, traced.depth_median),
            (out.normal_world, face_viewer(traced.normal_world, rays.directions_world).normal_world),
            *((layers[name], values) for name, values in shaded.layers.items()),
        ):
            # from tile order back to rows
            part[band].reshape(len(order), -1)[order] = values.reshape(len(order), -1)
    return out


def shade_layer(
    tracer: Tracer,
    image: ImageRays,
    pixels: Int64[np.ndarray, " p"],
    shading: ShadingModel,
    layer: str,
    sample: int,
) -> tuple[Float32[np.ndarray, "p f"], Float32[np.ndarray, " p"]]:
    """Return the color and alpha of a shading model's layer at some pixels of an image.

    Args:
        tracer: as for :func:`render_rays`.
        image: rays of all pixels.
        pixels: row-major numbers, neighbours side by side.
        shading: a model with that layer.
        layer: its name.
        sample: as for :func:`render_rays`.
    """
    found, alphas = [], []
    for start in range(0, len(pixels), RAYS_PER_BATCH):
        chosen = pixels[start : start + RAYS_PER_BATCH]
        rays = image.rays[chosen]
        traced = tracer.trace(rays)
        shaded = shading.shade(TracedRays(rays, traced, tracer, dither=pixel_jitter(chosen, sample)))
        found.append(shaded.layers[layer])
        alphas.append(traced.alpha)
    return np.concatenate(found), np.concatenate(alphas)


def front_normals(
    tracer: Tracer, image: ImageRays, depth_median: Float32[np.ndarray, "h w"]
) -> Float32[np.ndarray, "h w 3"]:
    """Return unit normals of the front surface, facing the viewer; 0 where nothing was hit.

    Where a thing ends before another, the mean normal along a ray is of both. Here rays end just behind the
    depth at which half of their light is gone, so that it is of the first.

    Args:
        tracer: as it was for :func:`render_rays`.
        image: the rays, with unit directions.
        depth_median: that which :func:`render_rays` found along them.
    """
    out = np.empty((image.height_px, image.width_px, 3), np.float32)
    for band, order, rays in _row_bands(image):
        depth = depth_median[band].reshape(-1)[order]
        ends = np.where(depth > 0, depth * np.float32(1 + FRONT_DEPTH_TOLERANCE), np.inf).astype(np.float32)
        traced = tracer.trace(replace(rays, t_max=np.minimum(rays.t_max, ends).astype(np.float32)))
        out[band].reshape(-1, 3)[order] = face_viewer(traced.normal_world, rays.directions_world).normal_world
    return out


def dominant_gaussians(
    tracer: Tracer, gaussians: FlatGaussians, image: ImageRays
) -> Int32[np.ndarray, "h w"]:
    """Return the Gaussian with the largest weight on each pixel's ray, -1 where it hit none.

    Args:
        tracer: built around ``gaussians``.
        gaussians: the scene.
        image: the rays, with unit directions.
    """
    out = np.empty((image.height_px, image.width_px), np.int32)
    for band, order, rays in _row_bands(image, RECORDED_RAYS_PER_BATCH):
        traced = tracer.trace(rays, record=True)
        assert traced.recording is not None
        found = ray_hits.dominant_gaussians(gaussians, rays, traced.recording, tracer.settings)
        out[band].reshape(-1)[order] = found
    return out


def _row_bands(
    image: ImageRays, rays_at_once: int = RAYS_PER_BATCH
) -> Iterator[tuple[slice, Int64[np.ndarray, " r"], RayBatch]]:
    """Yield bands of an image: its rows, the pixels' numbers in tiles, and their rays."""
    height, width = image.height_px, image.width_px
    rows = max(1, rays_at_once // (width * TILE_SIZE)) * TILE_SIZE  # whole tiles, so that packets are full
    for top in range(0, height, rows):
        count = min(rows, height - top)
        order = tile_order(count, width)
        yield slice(top, top + count), order, image.rays[top * width + order]


def tile_order(height: int, width: int) -> Int64[np.ndarray, " r"]:
    """Return row-major numbers of an image's pixels, tile after tile."""
    y, x = np.divmod(np.arange(height * width), width)
    across = -(-width // TILE_SIZE)
    return np.argsort((y // TILE_SIZE) * across + x // TILE_SIZE, kind="stable")


def pixel_jitter(pixels: Int64[np.ndarray, " r"], sample: int) -> Float64[np.ndarray, "2 r"]:
    """Return two numbers in [0, 1) for each pixel, a low-discrepancy sequence over the samples.

    Steps of the plastic number's powers, from a place of the pixel's own: "The Unreasonable Effectiveness of
    Quasirandom Sequences" (Roberts 2018, https://extremelearning.com.au).
    """
    return (hashed_uniforms(pixels.astype(np.uint64)) + sample * STEPS[:, None]) % 1.0


def background_color(name: str) -> Float32[np.ndarray, "3"]:
    """Return the color called ``black`` or ``white``."""
    return np.full(3, 1.0 if name == "white" else 0.0, np.float32)
