"""Evaluation at smaller resolutions than the one trained at, against downscaled photographs.

After the test of "Mip-Splatting: Alias-free 3D Gaussian Splatting" (https://arxiv.org/abs/2311.16493), which
renders at 1/2, 1/4 and 1/8 of the size and compares with photographs averaged over as many pixels.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.color import composite_over
from octasplat.engine.core.psnr import psnr
from octasplat.engine.core.rays import ImageRays
from octasplat.engine.dataset import Dataset
from octasplat.engine.evaluate.metrics import quantize_8_bit
from octasplat.engine.render.supersampling import render_averaged
from octasplat.engine.shading.protocol import ShadingModel
from octasplat.engine.trace.protocol import Tracer
from octasplat.engine.train.shading_factory import shading_for_view


def measure_multiscale(
    dataset: Dataset,
    tracer: Tracer,
    shading: ShadingModel,
    background_srgb: Float32[np.ndarray, "3"],
    scales: Sequence[int],
    rays_across: Sequence[int],
    on_view: Callable[[int], None] = lambda _done: None,
) -> dict[str, dict[str, float]]:
    """Return the mean PSNR over the held-out views at each scale, dB, with so many rays across a pixel.

    Args:
        dataset: photographs and split.
        tracer: built around the Gaussians, with the features of ``shading``.
        shading: what the scene was trained with.
        background_srgb: behind renders and photographs with alpha.
        scales: a pixel is so many of the photograph's across, and down.
        rays_across: so many rays across a pixel, and down.
        on_view: called with the number of views done.

    Returns:
        By scale, as ``1/4``, and by rays per pixel, as ``1`` or ``4``.
    """
    found: dict[str, dict[str, list[float]]] = {}
    for done, index in enumerate(dataset.test_indices.tolist(), start=1):
        rgb, alpha, weight = dataset.view_image(index)
        photograph = composite_over(rgb, alpha, background_srgb)
        rays, view_shading = dataset.view_rays(index), shading_for_view(shading, index)
        for scale in scales:
            if min(weight.shape) < scale:
                continue
            # Only blocks of nothing but valid pixels count.
            counts = (block_means(weight[..., None], scale)[..., 0] == 1).astype(np.float32)
            small = quantize_8_bit(block_means(photograph, scale))
            for across in rays_across:
                image = render_averaged(
                    tracer, downscale_rays(rays, scale), background_srgb, view_shading, across
                )
                value = psnr(quantize_8_bit(image.rgb_srgb), small, counts)
                if np.isfinite(value):
                    row = found.setdefault(f"1/{scale}", {})
                    row.setdefault(str(across * across), []).append(value)
        on_view(done)
    return {
        scale: {rays: float(np.mean(values)) for rays, values in row.items()} for scale, row in found.items()
    }


def block_means(image: Float32[np.ndarray, "h w c"], side: int) -> Float32[np.ndarray, "h2 w2 c"]:
    """Return means over blocks of ``side`` x ``side`` pixels; incomplete blocks are left out."""
    height, width = image.shape[0] // side, image.shape[1] // side
    cut = image[: height * side, : width * side].astype(np.float64)
    means = cut.reshape(height, side, width, side, -1).mean(axis=(1, 3))
    return means.astype(np.float32)


def downscale_rays(rays: ImageRays, side: int) -> ImageRays:
    """Return the rays through the centres of ``side`` x ``side`` pixel blocks, see :func:`block_means`."""
    if side == 1:
        return rays
    ways = block_means(rays.directions_world, side).astype(np.float64)
    ways /= np.linalg.norm(ways, axis=2, keepdims=True)
    return ImageRays.from_directions(rays.origin_world, ways.astype(np.float32), float(rays.rays.t_min[0]))
