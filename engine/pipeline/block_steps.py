"""Steps of a run in blocks: the plan and one block, each for a process of its own, or all that is missing."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from octasplat.engine.blocks.block_merge import BlockScene
from octasplat.engine.blocks.block_photographs import (
    BlockPhotographs,
    read_block_photographs,
    write_block_photographs,
)
from octasplat.engine.blocks.block_scene import plan_scene, train_block, train_in_blocks
from octasplat.engine.blocks.piece_progress import PieceProgress
from octasplat.engine.blocks.piece_training import RESULT, BlockWork
from octasplat.engine.blocks.scene_plan import (
    COARSE,
    ScenePlan,
    block_name,
    has_plan,
    load_plan,
    load_plan_to_train,
)
from octasplat.engine.core.events import Noted, PhaseStarted, Warned, ignore_events
from octasplat.engine.core.progress import phase
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.dataset_part import photograph_facts
from octasplat.engine.pipeline.run import ReconstructionRun
from octasplat.engine.runs.run_dataset import open_run_dataset
from octasplat.engine.runs.run_folder import BLOCKS, CACHE, SCENE, found_model_folder
from octasplat.engine.train.views.exposure_changes import resolve_exposure


@dataclass(frozen=True)
class PlanBlocks:
    """Train the coarse scene and plan the blocks of a run that has several; nothing for any other."""

    is_needed_later = True

    def is_done(self, run: ReconstructionRun) -> bool:
        """Return whether the plan or the scene exists."""
        return has_plan(run.output / BLOCKS) or (run.output / SCENE).exists()

    def __call__(self, run: ReconstructionRun) -> None:
        """Train the coarse scene and write the plan.

        Raises:
            ConfigError: the scene cannot be cut into so many blocks.
        """
        if (count := count_blocks(run)) == 1:
            return
        run.progress(PhaseStarted("train"))  # which ends in another process
        assert run.blocks is not None
        work = _block_work(run)
        tell = PieceProgress(run.progress)
        most = run.blocks.most_gaussians
        plan = plan_scene(work, count, _CoarseDataset(run), tell, most_gaussians=most)
        views = (np.unique(block.pixels.view).tolist() for block in plan.blocks)
        record = BlockPhotographs(
            facts=photograph_facts(run.dataset), exposure=bool(work.config.exposure), views=tuple(views)
        )
        write_block_photographs(record, work.folder)
        shutil.rmtree(_coarse_cache(run), ignore_errors=True)


@dataclass(frozen=True)
class TrainBlock:
    """Train one block of a run that is planned.

    Attributes:
        number: of the block, from 1.
    """

    number: int
    is_needed_later = True

    def is_done(self, run: ReconstructionRun) -> bool:
        """Return whether the block is trained."""
        return (run.output / BLOCKS / block_name(self.number) / RESULT).exists()

    def __call__(self, run: ReconstructionRun) -> None:
        """Train the block.

        Raises:
            CheckpointError: the plan or the coarse scene is missing or damaged, or of a version with other
                results.
        """
        plan = load_plan_to_train(run.output / BLOCKS)
        known = read_block_photographs(run.output / BLOCKS)
        iterations = plan.iterations[self.number - 1]
        with phase("train", run.progress, iterations):
            tell = PieceProgress(run.progress)
            tell.expect({block_name(self.number): iterations})
            train_block(_block_work(run, known), plan, self.number, tell)


def count_blocks(run: ReconstructionRun) -> int:
    """Return the number of blocks of a run whose photographs are open; 1 trains the scene as a whole.

    A run that is planned has those of its plan, whatever the version that goes on with it would make of it.
    """
    if run.blocks is None:
        return 1
    if has_plan(run.output / BLOCKS):
        return len(load_plan(run.output / BLOCKS).blocks)
    return run.blocks.resolve(run.config, run.dataset)


def train_all_blocks(run: ReconstructionRun, count: int) -> BlockScene:
    """Train all that is missing of a scene in so many blocks."""
    assert run.blocks is not None
    work, most = _block_work(run), run.blocks.most_gaussians
    scene = train_in_blocks(work, count, _CoarseDataset(run), most_gaussians=most)
    shutil.rmtree(_coarse_cache(run), ignore_errors=True)
    return scene


def planned_blocks(output: Path) -> ScenePlan | None:
    """Return the plan of a run that has one and whose scene is not trained yet; None for any other.

    Raises:
        CheckpointError: it is damaged.
    """
    folder = output / BLOCKS
    return load_plan(folder) if has_plan(folder) and not (output / SCENE).exists() else None


def missing_blocks(output: Path, plan: ScenePlan) -> tuple[int, ...]:
    """Return the numbers of the blocks of a plan that are still to be trained."""
    numbers = enumerate(plan.iterations, start=1)
    return tuple(
        n for n, length in numbers if length and not (output / BLOCKS / block_name(n) / RESULT).exists()
    )


def block_files(output: Path, number: int) -> list[Path]:
    """Return the files of a trained block that the merge needs."""
    folder = output / BLOCKS / block_name(number)
    return sorted(path for path in folder.iterdir() if path.is_file())


class _CoarseDataset:
    """Opens the photographs of a run at another size, with a cache of its own."""

    def __init__(self, run: ReconstructionRun) -> None:
        self._run = run

    def __call__(self, side_px: int) -> Dataset:
        run = self._run
        smaller = run.config.model_copy(update={"max_side": side_px})
        run.progress(Noted(f"The photographs are opened at {side_px} pixels for the coarse scene."))
        return open_run_dataset(
            run.scene, run.output, smaller, run.threads, ignore_events,
            model_folder=found_model_folder(run.output), cache=_coarse_cache(run),
        )  # fmt: skip


def _coarse_cache(run: ReconstructionRun) -> Path:
    return run.output / BLOCKS / COARSE / CACHE


def _block_work(run: ReconstructionRun, known: BlockPhotographs | None = None) -> BlockWork:
    """Return what the trainings share; ``known`` is what was decided by all photographs, if that is known."""
    dataset, config = run.dataset, run.train_config
    decided = config.exposure if known is None else known.exposure
    exposure, exposure_changes = resolve_exposure(decided, dataset, has_materials=False)
    if exposure_changes is not None and not has_plan(run.output / BLOCKS):  # else it was told
        run.progress(Warned(f"{exposure_changes} That is learnt; exposure=false leaves it out."))
    return BlockWork(
        dataset,
        config.model_copy(update={"exposure": exposure}),
        run.output / BLOCKS,
        run.threads,
        run.progress,
        run.should_stop,
    )
