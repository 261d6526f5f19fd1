"""CPU seconds of what a held-out view takes, beside those of libraries that do the same, and differences.

    python -m benchmarks.image_metrics [--width 2000] [--height 1500] [--threads 1]

The images are made: waves with noise, and a copy that is shifted and noisier, in steps of 8 bits. Each
function is called once before it is timed, on a part of them. Libraries use one thread; CPU seconds are those
of all threads.
"""

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"  # before NVIDIA's library and torch are loaded

import flip_evaluator
import numpy as np
import OpenImageIO as oiio
import torch
from jaxtyping import Float32
from pytorch_msssim import ms_ssim as ms_ssim_by_torch
from skimage.metrics import structural_similarity as ssim_by_skimage

from octasplat.engine.evaluate.metrics import (
    PIXELS_PER_DEGREE,
    flip,
    quantize_8_bit,
    structural_similarity,
)
from octasplat.engine.render.image_files import shrink_to

REPORT_SIDE_PX = 800
_WARM_PX = 200
Image = Float32[np.ndarray, "h w 3"]


def make_pair(width_px: int, height_px: int, seed: int = 0) -> tuple[Image, Image]:
    """Return a picture and another one that resembles it, in steps of 8 bits."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height_px, 0:width_px].astype(np.float32) / np.float32(40)
    waves = np.stack([np.sin(x + y), np.cos(1.7 * x), np.sin(0.6 * y - x)], axis=2) * np.float32(0.4)
    picture = waves + np.float32(0.5) + rng.normal(0, 0.02, waves.shape).astype(np.float32)
    other = np.roll(picture, 2, axis=1) + rng.normal(0, 0.04, waves.shape).astype(np.float32)
    return quantize_8_bit(other), quantize_8_bit(picture)


def flip_by_library(render: Image, reference: Image) -> Float32[np.ndarray, "h w"]:
    """Return NVIDIA's error map."""
    settings = {"ppd": PIXELS_PER_DEGREE}
    error, _, _ = flip_evaluator.evaluate(
        reference, render, "LDR", applyMagma=False, computeMeanError=False, parameters=settings
    )
    return np.asarray(error).reshape(render.shape[:2])


def similarity_by_libraries(render: Image, reference: Image) -> tuple[float, float]:
    """Return SSIM over whole windows by scikit-image, and MS-SSIM by pytorch-msssim, both in float64."""
    x, y = render.astype(np.float64), reference.astype(np.float64)
    ssim = ssim_by_skimage(
        y, x, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1, channel_axis=-1
    )
    tensors = (torch.from_numpy(image).permute(2, 0, 1)[None] for image in (x, y))
    return float(ssim), float(ms_ssim_by_torch(*tensors, data_range=1.0))


def shrink_by_openimageio(image: Image) -> Image:
    """Return the image by OpenImageIO's resize."""
    height, width, channels = image.shape
    size = [round(side * REPORT_SIDE_PX / max(height, width)) for side in (width, height)]
    source = oiio.ImageBuf(oiio.ImageSpec(width, height, channels, oiio.FLOAT))
    source.set_pixels(source.roi, image)
    shrunk = oiio.ImageBufAlgo.resize(source, roi=oiio.ROI(0, size[0], 0, size[1], 0, 1, 0, channels))
    return np.asarray(shrunk.get_pixels(oiio.FLOAT)).reshape(size[1], size[0], channels)


def timed(function: Callable[..., Any], *images: Image, **options: Any) -> tuple[Any, float]:
    """Return a result and its CPU seconds, after a call on a part of the images."""
    function(*(np.ascontiguousarray(image[:_WARM_PX, :_WARM_PX]) for image in images), **options)
    began = time.process_time()
    return function(*images, **options), time.process_time() - began


def report(name: str, ours: float, theirs: float, difference: str) -> None:
    """Print a line of the table."""
    print(f"| {name} | {ours:.2f} | {theirs:.2f} | {theirs / ours:.1f} | {difference} |")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--width", type=int, default=2000)
    parser.add_argument("--height", type=int, default=1500)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    pair = make_pair(options.width, options.height)
    print("| | CPU s | CPU s of the library | times | largest difference |\n|---|---|---|---|---|")
    error, ours = timed(lambda *images: flip(*images, threads=options.threads).error, *pair)
    expected, theirs = timed(flip_by_library, *pair)
    report("FLIP, NVIDIA's library", ours, theirs, f"{np.abs(error - expected).max():.0e} of a pixel")
    found, ours = timed(structural_similarity, *pair, threads=options.threads)
    indices, theirs = timed(similarity_by_libraries, *pair)
    apart = max(abs(found.ssim_valid - indices[0]), abs((found.ms_ssim or 0.0) - indices[1]))
    report("SSIM and MS-SSIM, scikit-image and pytorch-msssim", ours, theirs, f"{apart:.0e}")
    small, ours = timed(lambda image: shrink_to(image, REPORT_SIDE_PX), pair[0])
    expected, theirs = timed(shrink_by_openimageio, pair[0])
    inner = np.s_[10:-10, 10:-10]
    report(
        "a picture of the report, OpenImageIO",
        ours,
        theirs,
        f"{np.abs(small - expected)[inner].max():.0e} of a pixel away from the borders",
    )


if __name__ == "__main__":
    main()
