"""Cost of a reconstruction in blocks: the coarse scene, each block, and the end of the training.

As :mod:`octasplat.engine.operations.cost_model`, it imports neither torch nor numba, so that a front end can
use it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from octasplat.engine.blocks.piece_settings import (
    FINISH_FRACTION,
    FIRST_PART,
    POLISH_FRACTION,
    block_margin,
    block_settings,
    coarse_settings,
    coarse_side_px,
    fewest_blocks,
    fits_together,
)
from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.block_options import BlockOptions, parse_memory
from octasplat.engine.operations.cost_model import (
    Estimate,
    capped_sizes,
    estimate_reconstruction,
    gaussians_within,
    held_out_count,
    model_bytes,
    ray_cost_growth,
    training_pixels,
)
from octasplat.engine.train.config import max_gaussian_count

if TYPE_CHECKING:
    from octasplat.engine.runs.config import ReconstructionConfig


@dataclass(frozen=True)
class BlockShare:
    """What a block takes of a scene.

    Attributes:
        share: of what is seen, that lies in the block and its margin.
        view_count: training views that show some of it.
        drawn_pixel_count: pixels of them, those of each place counted by how much of it shows the block.
    """

    share: float
    view_count: int
    drawn_pixel_count: int


@dataclass(frozen=True)
class BlockCosts:
    """Estimates of the parts of a reconstruction in blocks, on so many cores.

    Attributes:
        blocks: each block by itself.
        extra_seconds: for the coarse scene, and for finishing or polishing the merged one.
        total: of all of it.
    """

    blocks: tuple[Estimate, ...]
    extra_seconds: float
    total: Estimate


def estimate_blocks(
    config: "ReconstructionConfig",
    photographs: Sequence[ImageSizes],
    shares: Sequence[BlockShare],
    most_gaussians: int | None,
    cores: int,
) -> BlockCosts:
    """Return what a reconstruction in these blocks takes, one after the other.

    Args:
        config: of the reconstruction, with poses decided.
        photographs: sizes of the photographs.
        shares: of the blocks.
        most_gaussians: of any block; None for no such limit.
        cores: to reckon with.
    """
    whole = estimate_reconstruction(config, photographs, cores)
    shrunk = [capped_sizes(sizes, config.max_side) for sizes in photographs]
    longest = max((max(sizes.width_px, sizes.height_px) for sizes in shrunk), default=1)
    smaller = config.model_copy(
        update={"train": coarse_settings(config.train), "max_side": coarse_side_px(longest)}
    )
    coarse = estimate_reconstruction(smaller, photographs, cores)
    coarse_count = max_gaussian_count(smaller.train, training_pixels(smaller, photographs))
    # Blocks that are alike, as thousands of an even guess, are reckoned once.
    total_count = sum(sizes.count for sizes in photographs)
    found = {
        block: _estimate_block(config, block, most_gaussians, cores, total_count)
        for block in dict.fromkeys(shares)
    }
    costs, counts = zip(*(found[block] for block in shares), strict=True)
    block_bytes = [cost.memory_bytes for cost in costs]
    # A block's rays meet the coarse Gaussians around it, and the last piece's those of all blocks.
    alone = [cost.stage_seconds["train"] for cost in costs]
    around = [round((1 - block.share) * coarse_count) for block in shares]
    merged_count = round(sum(counts) / max(1.0, sum(block.share for block in shares)))
    block_seconds, last_pieces = [], []
    is_finished_together = fits_together(config.train, training_pixels(config, photographs), most_gaussians)
    part = FIRST_PART if is_finished_together else 1.0
    for seconds, count, others in zip(alone, counts, around, strict=True):
        block_seconds.append(part * seconds * ray_cost_growth(config.train, count, count + others))
        last_pieces.append(seconds * ray_cost_growth(config.train, count, max(count, merged_count)))
    costs = tuple(
        cost.model_copy(
            update={
                "seconds": round(cost.seconds + seconds - before, 1),
                "stage_seconds": {**cost.stage_seconds, "train": round(seconds, 1)},
            }
        )
        for cost, seconds, before in zip(costs, block_seconds, alone, strict=True)
    )
    last_seconds = POLISH_FRACTION * max(last_pieces)
    if is_finished_together:
        last_seconds = FINISH_FRACTION * FIRST_PART * sum(last_pieces)
        block_bytes.append(whole.memory_bytes)
    # photographs are decoded once more, smaller, for the coarse scene
    extra = coarse.stage_seconds["load"] + coarse.stage_seconds["train"] + last_seconds
    longer = extra + sum(block_seconds) - whole.stage_seconds["train"]
    seconds = whole.seconds + longer
    total = whole.model_copy(
        update={
            "seconds": round(seconds, 1),
            "cpu_seconds": round(whole.cpu_seconds * seconds / whole.seconds, 1),
            "memory_bytes": max(coarse.memory_bytes, *block_bytes),
            "stage_seconds": {**whole.stage_seconds, "train": round(extra + sum(block_seconds), 1)},
        }
    )
    return BlockCosts(costs, round(extra, 1), total)


def _estimate_block(
    config: "ReconstructionConfig",
    block: BlockShare,
    most_gaussians: int | None,
    cores: int,
    photograph_count: int,
) -> tuple[Estimate, int]:
    """Return the estimate of the training of a block by itself, and its most Gaussians.

    It reads the model of all photographs, whichever show the block.
    """
    train = block_settings(config.train, block.share, most_gaussians, is_finished_later=False)
    # as photographs of which all are trained on and all pixels show the block
    views = max(block.view_count, 1)
    side = max(1, round((block.drawn_pixel_count / views) ** 0.5))
    alone = config.model_copy(update={"train": train, "held_out": (), "max_side": None})
    cost = estimate_reconstruction(alone, [ImageSizes(side, side, views)], cores)
    others = model_bytes(max(0, photograph_count - views))
    cost = cost.model_copy(update={"memory_bytes": cost.memory_bytes + others})
    return cost, max_gaussian_count(train, block.drawn_pixel_count)


def estimate_with_blocks(
    config: "ReconstructionConfig", options: BlockOptions, photographs: Sequence[ImageSizes], cores: int
) -> Estimate:
    """Return the estimate of a reconstruction in the blocks that its options ask for, all alike.

    What each block takes is known when there is a model (``octasplat plan``); until then each is reckoned
    with an equal part of what the photographs show, and its margin.

    Args:
        config: of the reconstruction, with poses decided.
        options: of the blocks.
        photographs: sizes of the photographs.
        cores: to reckon with.

    Raises:
        ConfigError: the memory is no size.
    """
    most = None
    if options.memory is not None:
        most = max(1, gaussians_within(config, photographs, parse_memory(options.memory)))
    count = sum(sizes.count for sizes in photographs)
    views, pixels = count - held_out_count(config, count), training_pixels(config, photographs)
    blocks = options.blocks
    if blocks == "auto":
        blocks = fewest_blocks(config.train, views, pixels, most)
    if blocks is None or blocks <= 1:  # auto makes none of no photographs
        return estimate_reconstruction(config, photographs, cores)
    margin = block_margin(is_finished_later=fits_together(config.train, pixels, most))
    share = min(1.0, (1 + 2 * margin) / blocks)
    each = BlockShare(share, max(1, min(views, math.ceil(2 * share * views))), max(1, round(share * pixels)))
    return estimate_blocks(config, photographs, [each] * blocks, most, cores).total
