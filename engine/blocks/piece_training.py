"""Training of one piece of a scene: resumed from its checkpoints, and kept in one file when it is done."""

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from octasplat.engine.core import versions
from octasplat.engine.core.events import EventListener, Warned
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset import Dataset
from octasplat.engine.dataset.camera_clearance import CameraClearance, camera_clearances
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.train.config import TrainConfig
from octasplat.engine.train.loop.checkpoint import (
    BestState,
    load_best,
    load_latest_checkpoint,
    run_fingerprint,
    save_best,
)
from octasplat.engine.train.loop.state import MinScale, TrainState
from octasplat.engine.train.loop.trainer import Trainer
from octasplat.engine.train.sampling.pixel_sampler import TrainingData

RESULT, RECORD, CHECKPOINTS = "best.npz", "piece.json", "checkpoints"
"""Files of a piece: its Gaussians and shading when it is done, what it took, and checkpoints before that."""


@dataclass(frozen=True)
class BlockWork:
    """What the trainings of a run in blocks share.

    Attributes:
        dataset: the photographs at their full working size.
        config: settings of the training, with the exposure decided.
        folder: of the pieces, in the folder of the run.
        threads: for everything; 0 means all cores.
        progress: receives the events.
        should_stop: asked now and then; True stops after a checkpoint.
    """

    dataset: Dataset
    config: TrainConfig
    folder: Path
    threads: int
    progress: EventListener
    should_stop: Callable[[], bool]


@dataclass(frozen=True)
class Piece:
    """A training of its own among those of a run in blocks.

    Attributes:
        name: of its folder.
        data: what it is trained on.
        config: settings of it.
        start: makes the state before its first iteration.
        fixed_gaussians: Gaussians that are seen, too, and stay as they are.
        is_fixed_in_files: whether what is traced, fixed Gaussians and others, is in files meanwhile: for many
            fixed ones and a number of others that stays.
        keeps_near_free: whether no Gaussian stays near to a camera.
    """

    name: str
    data: TrainingData
    config: TrainConfig
    start: Callable[[], TrainState]
    fixed_gaussians: FlatGaussians | None = None
    is_fixed_in_files: bool = False
    keeps_near_free: bool = True


def is_piece_done(work: BlockWork, name: str) -> bool:
    """Return whether the result of a piece exists, of a version that has the results of this one."""
    folder = work.folder / name
    return (folder / RESULT).exists() and versions.has_same_results(_read_record(folder))


def piece_record(work: BlockWork, name: str) -> dict[str, float]:
    """Return the iterations, seconds and Gaussians of a piece; nothing where it was not trained."""
    record = _read_record(work.folder / name)
    return {key: value for key, value in record.items() if key != versions.STATED}


def _read_record(folder: Path) -> dict[str, float]:
    path = folder / RECORD
    record: dict[str, float] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    return record


def train_piece(work: BlockWork, piece: Piece, progress: EventListener) -> BestState:
    """Train a piece, go on with its training, or return what it came to.

    Its checkpoints are removed when it is done, so that only those of one piece lie on the disk. What is of a
    version with other results is trained anew.

    Args:
        work: what all pieces share.
        piece: what to train.
        progress: receives the events of this training.

    Raises:
        CheckpointError: its files belong to other settings or photographs, or are damaged.
        TrainingError: training collapsed.
        CancelledError: stopped as asked.
    """
    folder = work.folder / piece.name
    if is_piece_done(work, piece.name):
        return load_best(folder)
    if (folder / RESULT).exists():
        work.progress(
            Warned(
                f"{folder} was trained by a version in which the same settings gave other results, so it is "
                "trained anew."
            )
        )
        (folder / RESULT).unlink()
    checkpoints, config = folder / CHECKPOINTS, piece.config
    identity = f"{run_fingerprint(work.dataset, config)} {piece.name}"
    fingerprint = hashlib.sha256(identity.encode()).hexdigest()
    state = load_latest_checkpoint(checkpoints, fingerprint, progress)
    viewpoints, trained = work.dataset.viewpoints, work.dataset.train_indices
    zones = None
    if piece.keeps_near_free and config.camera_clearance > 0:
        nearest_world = camera_clearances(viewpoints, work.dataset.points)
        zones = CameraClearance.from_views(viewpoints, config.camera_clearance * nearest_world, trained)
    checkpoints.mkdir(parents=True, exist_ok=True)
    trainer = Trainer(
        piece.data,
        config,
        piece.start() if state is None else state,
        folder=checkpoints,
        fingerprint=fingerprint,
        progress=progress,
        threads=work.threads,
        should_stop=work.should_stop,
        min_scale=MinScale.of_views(viewpoints, trained, config.min_scale_px),
        camera_clearance=zones,
        fixed_gaussians=piece.fixed_gaussians,
        is_fixed_in_files=piece.is_fixed_in_files,
    )
    gaussians = trainer.run()
    record = {
        "iterations": trainer.state.iteration,
        "seconds": trainer.state.seconds,
        "gaussians": len(gaussians),
        "taken_near": trainer.state.pruned_near_cameras,
        versions.STATED: versions.RESULTS_VERSION,
    }
    write_json(folder / RECORD, record)
    result = BestState(gaussians, trainer.shading.state())
    save_best(result, folder)
    shutil.rmtree(checkpoints)
    return result
