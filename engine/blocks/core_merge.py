"""The cores of trained blocks as one scene, put together in files one block at a time."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from octasplat.engine.blocks.block_plan import Block
from octasplat.engine.blocks.scene_plan import ScenePlan
from octasplat.engine.gaussians.merge import with_sh_degree
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.rows import allocate_rows
from octasplat.engine.gaussians.simplification import simplify
from octasplat.engine.train.config import TrainConfig
from octasplat.engine.train.loop.checkpoint import BestState, load_best


def merge_cores(
    folder: Path, config: TrainConfig, plan: ScenePlan, coarse: BestState
) -> tuple[FlatGaussians, Bool[np.ndarray, " n"]]:
    """Return the Gaussians of all cores, block after block, and which of them are near to cuts.

    The Gaussians are in files without a name.

    Args:
        folder: of the pieces, with all blocks; the files without a name are there, too.
        config: of the run.
        plan: of the scene.
        coarse: the coarse scene.

    Raises:
        CheckpointError: a block is missing or damaged.
        DiskFullError: there is no room for the files.
    """

    def core_of(name: str, block: Block) -> FlatGaussians:
        """Return the Gaussians of a core; those of the coarse scene where few views show it."""
        found = (load_best(folder / name) if block.is_trained else coarse).gaussians
        return with_sh_degree(found.select(block.core.contains(found.means_world)), config.sh_degree)

    blocks = list(zip(plan.block_names, plan.blocks, strict=True))
    counts = limited_counts([len(core_of(*block)) for block in blocks], config.max_gaussians)
    ends = np.cumsum([0, *counts]).tolist()
    merged = allocate_rows(with_sh_degree(coarse.gaussians, config.sh_degree), ends[-1], folder)
    is_near_cut = np.empty(ends[-1], np.bool_)
    for (name, block), (start, end) in zip(blocks, pairwise(ends), strict=True):
        core = simplify(core_of(name, block), end - start, folder=folder)
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
