"""Reconstructions and trainings that are stopped on the way, to be gone on with."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from octasplat.engine.core.errors import CancelledError
from octasplat.engine.core.events import Event, PhaseStarted
from octasplat.engine.pipeline import reconstruct
from octasplat.engine.runs.config import ReconstructionConfig
from octasplat.engine.train.loop.checkpoint import latest_checkpoint, load_checkpoint
from octasplat.engine.train.loop.state import TrainState
from octasplat.engine.train.loop.trainer import Trainer


def reconstruct_until(stage: str, dataset: Path, output: Path, config: ReconstructionConfig) -> list[str]:
    """Begin a run or go on with one, and stop it in a stage; returns the stages that had begun."""
    begun: list[str] = []

    def note(event: Event) -> None:
        if isinstance(event, PhaseStarted):
            begun.append(event.stage)

    with pytest.raises(CancelledError, match="--resume"):
        reconstruct(
            dataset, output, config, resume=True, progress=note, should_stop=lambda: begun[-1:] == [stage]
        )
    return begun


def train_with_a_stop(
    make_trainer: Callable[[TrainState, float], Trainer],
    state: TrainState,
    folder: Path,
    stop_after: int | None,
) -> tuple[Trainer, TrainState]:
    """Train to the end; with ``stop_after``, stop there and go on from the checkpoint with a fresh trainer.

    Args:
        make_trainer: of a state and the iteration at which to stop.
        state: to begin from.
        folder: where the checkpoints are, of a training with the fingerprint "test".
        stop_after: the iteration, or None.

    Returns:
        The last trainer, and the state that it trained.
    """
    if stop_after is not None:
        with pytest.raises(CancelledError):
            make_trainer(state, stop_after).run()
        path = latest_checkpoint(folder)
        assert path is not None
        state = load_checkpoint(path, "test")
    trainer = make_trainer(state, np.inf)
    trainer.run()
    return trainer, state
