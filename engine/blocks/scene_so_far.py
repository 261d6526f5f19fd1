"""What the blocks of a run have learnt while others are still trained."""

from pathlib import Path

from octasplat.engine.blocks.piece_training import RESULT
from octasplat.engine.blocks.scene_plan import COARSE, block_name, has_plan, load_plan
from octasplat.engine.gaussians.merge import with_sh_degree
from octasplat.engine.gaussians.model import FlatGaussians, concatenate
from octasplat.engine.runs.run_folder import BLOCKS, SCENE
from octasplat.engine.train.loop.checkpoint import load_best


def scene_so_far(output: Path) -> FlatGaussians | None:
    """Return the cores of the blocks that are trained, and the coarse Gaussians of the others.

    Args:
        output: folder of a run.

    Returns:
        The scene; None where the run is not in blocks, has no plan yet or has its own scene.

    Raises:
        CheckpointError: the plan or a piece is damaged, or is gone as the run has ended meanwhile.
    """
    folder = output / BLOCKS
    if not has_plan(folder) or (output / SCENE).exists():
        return None
    cores = []
    coarse = load_best(folder / COARSE).gaussians
    for number, block in enumerate(load_plan(folder).blocks, start=1):
        own = folder / block_name(number)
        found = load_best(own).gaussians if (own / RESULT).exists() else coarse
        cores.append(found.select(block.core.contains(found.means_world)))
    degree = max(core.sh_degree for core in cores)
    return concatenate([with_sh_degree(core, degree) for core in cores])
