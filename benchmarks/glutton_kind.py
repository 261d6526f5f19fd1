"""A kind of job that writes until its disk is full; :mod:`benchmarks.chaos` names it to its workers."""

import os
import time

from pydantic import BaseModel, ConfigDict

from octasplat.engine.core.events import PhaseProgress, PhaseStarted
from octasplat.workers.worker.job_kinds import JobKind, register
from octasplat.workers.worker.task import Task

PIECE_BYTES = 1 << 20
MOST_PIECES = 4096


class GluttonOptions(BaseModel):
    """It has none."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def run(task: Task) -> None:
    """Write, and tell of it, until there is no room."""
    task.progress(PhaseStarted("train", MOST_PIECES))
    task.run.mkdir(parents=True, exist_ok=True)
    with (task.run / "glutton").open("wb", buffering=0) as handle:
        for number in range(MOST_PIECES):
            handle.write(os.urandom(PIECE_BYTES))
            task.progress(PhaseProgress("train", number + 1, MOST_PIECES))
            time.sleep(0.005)


register(
    JobKind(
        name="glutton",
        title="Takes all room",
        needs="dataset",
        options=GluttonOptions,
        program="benchmarks.glutton_kind:run",
        stages=("train",),
    )
)
