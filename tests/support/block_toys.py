"""Kinds of jobs in blocks that only count: the whole, and its blocks; workers under test import it."""

import time
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from octasplat.engine.core.errors import CancelledError, DatasetError
from octasplat.engine.core.events import CheckpointWritten, PhaseFinished, PhaseProgress, PhaseStarted
from octasplat.workers.worker.job_kinds import JobKind, register
from octasplat.workers.worker.task import BlocksPlanned, Task


class BlockToyOptions(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    blocks: int = 3
    steps: int = 10
    refuse: int = 0
    """The block of this number refuses for as long as the file ``gate`` is not there."""
    hold: int = 0
    """Blocks from this number on wait in the middle for the file ``gate``; 0 lets none."""
    gate: str = ""


class ToyBlockOptions(BlockToyOptions):
    number: int
    iterations: int
    plan: str


def plan(task: Task) -> None:
    """Plan blocks, or add up what they have made."""
    options = BlockToyOptions.model_validate(task.options)
    folder = task.run / "blocks"
    folder.mkdir(parents=True, exist_ok=True)
    task.progress(PhaseStarted("train", options.steps))
    if not (folder / "plan.npz").exists():
        (folder / "plan.npz").write_text(f"{options.blocks} blocks")
    numbers = range(1, options.blocks + 1)
    results = [folder / f"block_{number:03d}" / "best.npz" for number in numbers]
    if not all(path.exists() for path in results):
        lengths = tuple(options.steps + number for number in numbers)
        task.progress(BlocksPlanned(tuple(numbers), lengths, 5, sum(lengths) + 10))
        return
    task.progress(PhaseFinished("train", 1.0))
    (task.results / "sum.txt").write_text(" ".join(path.read_text() for path in results))


def train(task: Task) -> None:
    """Count; the checkpoint tells how far."""
    options = ToyBlockOptions.model_validate(task.options)
    assert (task.run / "blocks" / "plan.npz").read_text() == f"{options.blocks} blocks"
    own = task.run / "blocks" / f"block_{options.number:03d}"
    checkpoints = own / "checkpoints"
    checkpoints.mkdir(parents=True, exist_ok=True)
    newest = max(checkpoints.glob("iteration_*.npz"), default=None)
    step = int(newest.read_text()) if newest else 0
    began = step
    steps = options.iterations
    task.progress(PhaseStarted("train", steps))
    if options.refuse == options.number and not Path(options.gate).exists():
        raise DatasetError("The toy refuses this block.")
    while step < steps:
        time.sleep(0.01)
        step += 1
        task.progress(PhaseProgress("train", step, steps))
        stop = task.should_stop()
        if stop or step % 5 == 0:
            path = checkpoints / f"iteration_{step:07d}.npz"
            path.with_suffix(".tmp").write_text(str(step))
            path.with_suffix(".tmp").rename(path)
            task.progress(CheckpointWritten(step, str(path)))
        if stop and step < steps:
            raise CancelledError("stopped")
        while 0 < options.hold <= options.number and step == 7 and not Path(options.gate).exists():
            if task.should_stop():
                break
            task.progress(PhaseProgress("train", step, steps))
            time.sleep(0.05)
    (own / "best.npz").write_text(f"{options.number}:{step}")
    task.progress(PhaseFinished("train", 1.0))
    target = task.results / "blocks" / own.name
    target.mkdir(parents=True)
    (target / "best.npz").write_text((own / "best.npz").read_text())
    (target / "piece.json").write_text(str(began))


class BlockToy(JobKind[BlockToyOptions]):
    """A kind whose program plans blocks."""

    block_kind = "toy_block"

    def options_of_block(
        self, options: BlockToyOptions, number: int, iterations: int, plan: str
    ) -> dict[str, Any]:
        own = {"number": number, "iterations": iterations, "plan": plan}
        return {**options.model_dump(mode="json"), **own}


class ToyBlock(JobKind[ToyBlockOptions]):
    """A kind that only such a job queues."""

    is_internal = True


register(
    BlockToy(
        name="block_toy",
        title="Counts in blocks",
        needs="dataset",
        options=BlockToyOptions,
        program="tests.support.block_toys:plan",
        stages=("train",),
    )
)
register(
    ToyBlock(
        name="toy_block",
        title="Counts",
        needs="dataset",
        options=ToyBlockOptions,
        program="tests.support.block_toys:train",
        stages=("train",),
    )
)
