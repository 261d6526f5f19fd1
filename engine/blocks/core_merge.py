"""The cores of trained blocks as one scene, put together in files one block at a time."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Bool

from octasplat.engine.blocks.piece_training import BlockWork
from octasplat.engine.blocks.scene_plan import ScenePlan, block_name
from octasplat.engine.gaussians.merge import with_sh_degree
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.rows import allocate_rows
from octasplat.engine.gaussians.simplification import simplify
from octasplat.engine.train.loop.checkpoint import BestState, load_best


def merge_cores(
    work: BlockWork, plan: ScenePlan, coarse: BestState
) -> tuple[FlatGaussians, Bool[np.ndarray, " n"]]:
    """Return the Gaussians of all cores, block after block, and which of them are near to cuts.

    The Gaussians are in files without a name in the folder of the pieces.

    Args:
        work: settings and the folder with all blocks.
        plan: of the scene.
        coarse: the coarse scene.

    Raises:
        CheckpointError: a block is missing or damaged.
        DiskFullError: there is no room for the files.
    """
    numbers = range(1, len(plan.blocks) + 1)
    found = [len(_core_of_block(work, plan, number, coarse)) for number in numbers]
    counts = limited_counts(found, work.config.max_gaussians)
    ends = np.cumsum([0, *counts]).tolist()
    merged = allocate_rows(with_sh_degree(coarse.gaussians, work.config.sh_degree), ends[-1], work.folder)
    is_near_cut = np.empty(ends[-1], np.bool_)
    for number, (start, end) in zip(numbers, pairwise(ends), strict=True):
        block = plan.blocks[number - 1]
        core = simplify(_core_of_block(work, plan, number, coarse), end - start, folder=work.folder)
        merged.put(slice(start, end), core)
        inner = block.core.grown(-block.margin_world)
        is_near_cut[start:end] = ~inner.contains(core.means_world)
    return merged, is_near_cut


def limited_counts(counts: Sequence[int], most: int) -> list[int]:
    """Return how many Gaussians of each core stay, where the whole scene may have so many.

    Blocks share that number by what they and their margins show, so that the cores may have a few more. Of a
    core that has any, one at least stays.

    Args:
        counts: of the cores.
        most: of all together; 0 for no limit.

    >>> limited_counts([30, 0, 50], 40), limited_counts([30, 0, 50], 0)
    ([15, 0, 25], [30, 0, 50])
    """
    ends = np.cumsum(counts)
    if not 0 < most < ends[-1]:
        return list(counts)
    shares = np.diff(ends * most // ends[-1], prepend=0).tolist()
    return [min(count, max(1, share)) for count, share in zip(counts, shares, strict=True)]


def _core_of_block(work: BlockWork, plan: ScenePlan, number: int, coarse: BestState) -> FlatGaussians:
    """Return the Gaussians of a block's core; those of the coarse scene where few views show it."""
    block = plan.blocks[number - 1]
    found = load_best(work.folder / block_name(number)) if block.is_trained else coarse
    core = found.gaussians.select(block.core.contains(found.gaussians.means_world))
    return with_sh_degree(core, work.config.sh_degree)
