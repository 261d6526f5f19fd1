"""A short job whose every byte depends on every step and on the photographs: a chain of digests.

Workers under chaos import it by ``OCTASPLAT_KIND_MODULES``.
"""

import hashlib
import json
import os
import time
from collections.abc import Mapping
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.events import CheckpointWritten, PhaseFinished, PhaseProgress, PhaseStarted
from octasplat.workers.worker.job_kinds import JobKind, register
from octasplat.workers.worker.task import Task

EVERY = 5
RESULT_BLOCKS = 20_000


class ChainOptions(BaseModel):
    """Options of the chain."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    seed: int = 0
    steps: int = Field(60, ge=1)
    seconds: float = Field(0.05, ge=0)
    gate: str = ""
    """The last step is not made before this file is there."""


def start_of(photographs: Mapping[str, bytes], seed: int) -> bytes:
    """The first link: contents of the dataset by name, and a number."""
    digest = hashlib.sha256(str(seed).encode())
    for name, content in sorted(photographs.items()):
        digest.update(f"{name}\n{len(content)}\n".encode() + content)
    return digest.digest()


def link(before: bytes, step: int) -> bytes:
    """The next link."""
    return hashlib.sha256(before + step.to_bytes(8, "little")).digest()


def result_of(last: bytes) -> bytes:
    """What is published, 640 kB."""
    blocks = []
    for number in range(RESULT_BLOCKS):
        blocks.append(hashlib.sha256(last + number.to_bytes(8, "little")).digest())
    return b"".join(blocks)


def undisturbed(photographs: Mapping[str, bytes], options: ChainOptions) -> bytes:
    """The result of a run that nobody disturbs."""
    state = start_of(photographs, options.seed)
    for step in range(1, options.steps + 1):
        state = link(state, step)
    return result_of(state)


def run(task: Task) -> None:
    """Count, hash, write checkpoints, and publish."""
    options = ChainOptions.model_validate(task.options)
    assert task.scene is not None
    checkpoints = task.run / "checkpoints"
    checkpoints.mkdir(parents=True, exist_ok=True)
    newest = max(checkpoints.glob("iteration_*.npz"), default=None)
    if newest is None:
        files = (path for path in task.scene.rglob("*") if path.is_file())
        found = {path.relative_to(task.scene).as_posix(): path.read_bytes() for path in files}
        step, state = 0, start_of(found, options.seed)
    else:
        kept = json.loads(newest.read_text())
        step, state = kept["step"], bytes.fromhex(kept["state"])
    task.progress(PhaseStarted("train", options.steps))
    while step < options.steps:
        time.sleep(options.seconds)
        shut = options.gate and step == options.steps - 1 and not Path(options.gate).exists()
        if shut and not task.should_stop():
            task.progress(PhaseProgress("train", step, options.steps))
            continue
        step += 1
        state = link(state, step)
        task.progress(PhaseProgress("train", step, options.steps))
        stop = task.should_stop()
        if stop or step % EVERY == 0:
            path = checkpoints / f"iteration_{step:07d}.npz"
            with path.with_suffix(".tmp").open("w") as handle:
                json.dump({"step": step, "state": state.hex()}, handle)
                handle.flush()
                os.fsync(handle.fileno())
            path.with_suffix(".tmp").replace(path)
            task.progress(CheckpointWritten(step, str(path)))
        if stop and step < options.steps:
            raise CancelledError("stopped")
    task.progress(PhaseFinished("train", 0.0))
    (task.results / "chain.bin").write_bytes(result_of(state))


register(
    JobKind(
        name="chain",
        title="Chain of digests",
        needs="dataset",
        options=ChainOptions,
        program="benchmarks.chaos_kind:run",
        stages=("train",),
    )
)
