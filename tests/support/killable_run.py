"""Reconstructions in processes of their own, which can be killed.

They are forks of a server that has imported the engine, which takes a third of the time of a small run.
"""

import multiprocessing
from multiprocessing.context import ForkServerProcess
from pathlib import Path

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(
    [
        "octasplat.engine.pipeline",
        "octasplat.engine.dataset.dataset",
        "octasplat.engine.train.loop.trainer",
        "octasplat.engine.evaluate.run_evaluation",
        "octasplat.engine.surface.extract",
    ]
)


def _reconstruct(scene: Path, output: Path, config: str, threads: int) -> None:
    from octasplat.engine.pipeline import reconstruct
    from octasplat.engine.runs.config import ReconstructionConfig

    given = ReconstructionConfig.model_validate_json(config)
    reconstruct(scene, output, given, resume=True, threads=threads)


def start_run(scene: Path, output: Path, config: str, threads: int) -> ForkServerProcess:
    """Begin a run or go on with one, with settings as JSON; its exit code is 0 once it is finished."""
    process = _CONTEXT.Process(target=_reconstruct, args=(scene, output, config, threads))
    process.start()
    return process
