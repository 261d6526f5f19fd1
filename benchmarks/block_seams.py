"""Whether the cuts between blocks show: held-out PSNR of a band around them, and elsewhere.

    python -m benchmarks.block_seams BLOCKS_RUN [OTHER_RUN...] [--width 0.02] [--dataset FOLDER]

``BLOCKS_RUN`` is a finished run in blocks. A pixel belongs to the band where the surface that it shows, by
the median depth of that run, lies within ``--width`` times the scene's spread of a side that a cut gave to
its block. The same pixels are measured in the other runs, such as one large training of the same photographs,
so that a difference which the place itself makes can be told from one that the cut makes. Prints a table of
Markdown.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float64

from benchmarks.held_out_error import Run
from octasplat.engine.blocks.partition import Box
from octasplat.engine.blocks.scene_plan import load_plan
from octasplat.engine.core.threads import use_threads
from octasplat.engine.evaluate.metrics import quantize_8_bit
from octasplat.engine.evaluate.view_support import psnr_of
from octasplat.engine.runs.run_folder import BLOCKS

SPREAD_QUANTILES = (0.05, 0.95)


def near_cuts(
    points_world: Float[np.ndarray, "n 3"], boxes: Sequence[Box], widths_world: Float64[np.ndarray, "3"]
) -> Bool[np.ndarray, " n"]:
    """Return which points lie within a width, given for each axis, of a side of the box that holds them."""
    near = np.zeros(len(points_world), bool)
    for box in boxes:
        inside = box.contains(points_world)
        beside = (points_world - box.low_world < widths_world) | (
            box.high_world - points_world < widths_world
        )
        near |= inside & beside.any(axis=1)
    return near


def measure(
    blocks: Run, others: Sequence[Run], boxes: Sequence[Box], width: float
) -> tuple[list[tuple[float, float]], float]:
    """Return the PSNR of the band and of the rest for each run, and the band's share of the pixels."""
    runs = [blocks, *others]
    points = blocks.gaussians.means_world
    low, high = np.quantile(points, SPREAD_QUANTILES, axis=0)
    widths = width * (high - low)
    sums = np.zeros((len(runs), 2))
    counts = np.zeros(2)
    for index in blocks.dataset.test_indices.tolist():
        name = blocks.dataset.views[index].name
        image = blocks.dataset.view_rays(index)
        reference, weight = blocks.photograph(index)
        depth = blocks.render(blocks.tracer, image, index).depth_median
        seen = ((depth > 0) & (weight > 0)).reshape(-1)
        surface = image.origin_world + depth[..., None] * image.directions_world
        band = near_cuts(surface.reshape(-1, 3).astype(np.float64), boxes, widths)
        groups = (seen & band, seen & ~band)
        counts += [group.sum() for group in groups]
        for row, run in enumerate(runs):
            place = [view.name for view in run.dataset.views].index(name)
            picture = quantize_8_bit(run.render(run.tracer, run.dataset.view_rays(place), place).rgb_srgb)
            squared = np.square(picture.astype(np.float64) - reference).mean(axis=-1).reshape(-1)
            sums[row] += [squared[group].sum() for group in groups]
    errors = sums / np.maximum(counts, 1)
    return [(psnr_of(float(a)), psnr_of(float(b))) for a, b in errors], float(counts[0] / counts.sum())


def main() -> None:
    """Measure the runs that are named."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("blocks", type=Path, metavar="BLOCKS_RUN")
    parser.add_argument("others", type=Path, nargs="*", metavar="OTHER_RUN")
    parser.add_argument("--width", type=float, default=0.02, help="of the scene's spread, to each side")
    parser.add_argument("--dataset", type=Path, help="the photographs, where they have moved")
    parser.add_argument("--threads", type=int, default=0)
    options = parser.parse_args()
    use_threads(options.threads)
    boxes = [block.core for block in load_plan(options.blocks / BLOCKS).blocks]
    runs = [Run(folder, options.dataset, options.threads) for folder in (options.blocks, *options.others)]
    rows, share = measure(runs[0], runs[1:], boxes, options.width)
    print(f"{share:.1%} of the pixels lie in the band of {options.width:.0%}.\n")
    print("| run | band, dB | elsewhere, dB | band less elsewhere, dB |\n|---|---|---|---|")
    for run, (band, rest) in zip(runs, rows, strict=True):
        print(f"| {run.folder.name} | {band:.2f} | {rest:.2f} | {band - rest:+.2f} |")


if __name__ == "__main__":
    main()
