"""The reconstruction job, from photographs to a measured scene and its meshes.

Each step leaves its result on disk and is skipped when the result is there, so that a run that was stopped
or killed goes on where it was.

    (find poses ->) open the dataset (-> mend poses and lenses) -> train -> evaluate -> export
"""

from octasplat.engine.pipeline.block_request import BlockRequest
from octasplat.engine.pipeline.block_steps import (
    PlanBlocks,
    TrainBlock,
    block_files,
    missing_blocks,
    planned_blocks,
)
from octasplat.engine.pipeline.reconstruction import reconstruct
from octasplat.engine.pipeline.run import OnStep

__all__ = [
    "BlockRequest",
    "OnStep",
    "PlanBlocks",
    "TrainBlock",
    "block_files",
    "missing_blocks",
    "planned_blocks",
    "reconstruct",
]
