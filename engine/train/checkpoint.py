"""Checkpoints: everything that the rest of a run depends on, in one file, written whole or not at all."""

import json
import struct
import zipfile
import zlib
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from engine.errors import CheckpointError, DamagedCheckpoint
from engine.gaussians.model import FlatGaussians
from engine.gaussians.rows import from_row_arrays, row_arrays
from engine.train.exposure import Exposures
from engine.train.optimiser import Adam
from engine.writing import replacing

FORMAT = 1
KEEP = 2
_PREFIX = "iteration_"
# What reading a damaged archive may raise; a flipped bit can ask for encryption or a lengthy array.
_DAMAGE = (
    OSError, KeyError, ValueError, TypeError, AttributeError, EOFError, RuntimeError, MemoryError,
    OverflowError, struct.error, zlib.error, zipfile.BadZipFile,
)  # fmt: skip


@dataclass
class TrainState:
    """The state before iteration ``iteration`` (0 at the start).

    Attributes:
        iteration: iterations done.
        gaussians: parameters.
        adam: optimiser state.
        rng: the generator that draws batches and everything else that is random.
        densifier: what the densification strategy has observed.
        seconds: training time so far, evaluation left out.
        running_mse: smoothed squared error of the training rays.
        best_psnr: best probe so far, dB; the Gaussians that reached it are in ``best.npz``.
        best_iteration: when that was.
        exposures: those of the views, where they are learnt.
    """

    iteration: int
    gaussians: FlatGaussians
    adam: Adam
    rng: np.random.Generator
    densifier: dict[str, np.ndarray]
    seconds: float = 0.0
    running_mse: float = 0.0
    best_psnr: float = -np.inf
    best_iteration: int = 0
    exposures: Exposures | None = None


def checkpoint_path(folder: Path, iteration: int) -> Path:
    """Where the checkpoint of ``iteration`` lies."""
    return folder / f"{_PREFIX}{iteration:07d}.npz"


def latest_checkpoint(folder: Path) -> Path | None:
    """The newest checkpoint of a run, or None."""
    return max(folder.glob(f"{_PREFIX}*.npz"), default=None)


def save_checkpoint(state: TrainState, folder: Path, fingerprint: str) -> Path:
    """Write the state and remove all but the newest checkpoints.

    Args:
        state: what to keep.
        folder: the run's checkpoint folder.
        fingerprint: names the configuration and data that the state belongs to.
    """
    path = checkpoint_path(folder, state.iteration)
    meta = {
        "format": FORMAT,
        "fingerprint": fingerprint,
        "iteration": state.iteration,
        "rng": state.rng.bit_generator.state,
        "seconds": state.seconds,
        "running_mse": state.running_mse,
        "best_psnr": state.best_psnr if np.isfinite(state.best_psnr) else None,
        "best_iteration": state.best_iteration,
    }
    arrays: dict[str, Any] = {
        f"gaussians.{name}": array for name, array in row_arrays(state.gaussians).items()
    }
    arrays |= {f"adam.{name}": array for name, array in row_arrays(state.adam).items()}
    arrays |= {f"densifier.{name}": value for name, value in state.densifier.items()}
    if state.exposures is not None:
        arrays |= {f"exposures.{f.name}": getattr(state.exposures, f.name) for f in fields(Exposures)}
    meta["arrays"] = sorted(arrays)
    with replacing(path) as temporary:
        np.savez(temporary, meta=np.array(json.dumps(meta)), **arrays)
    for left in folder.glob(".*.partial.npz"):  # of runs that were killed while they wrote
        left.unlink()
    for old in sorted(folder.glob(f"{_PREFIX}*.npz"))[:-KEEP]:
        old.unlink()
    return path


def load_checkpoint(path: Path, fingerprint: str) -> TrainState:
    """Read a checkpoint back.

    Raises:
        DamagedCheckpoint: the file cannot be read.
        CheckpointError: it belongs to another configuration or other photographs.
    """
    try:
        arrays = _read_arrays(path)
        meta = json.loads(str(arrays.pop("meta")))
        if sorted(arrays) != meta.get("arrays", sorted(arrays)):
            raise ValueError("arrays are missing")
        names = ("gaussians", "adam", "densifier", "exposures")
        groups: dict[str, dict[str, np.ndarray]] = {name: {} for name in names}
        for name, array in arrays.items():
            group, _, key = name.partition(".")
            groups[group][key] = array
    except _DAMAGE as error:
        raise DamagedCheckpoint(
            f"{path} is damaged ({error}); delete it to go on from the one before it."
        ) from None
    if meta.get("format") != FORMAT or meta["fingerprint"] != fingerprint:
        raise CheckpointError(
            f"{path} belongs to other settings or other photographs; "
            "give the settings it was made with, or choose another output folder."
        )
    rng = np.random.Generator(np.random.PCG64())
    rng.bit_generator.state = meta["rng"]
    return TrainState(
        iteration=meta["iteration"],
        gaussians=from_row_arrays(FlatGaussians, groups["gaussians"]),
        adam=from_row_arrays(Adam, groups["adam"]),
        rng=rng,
        densifier=groups["densifier"],
        seconds=meta["seconds"],
        running_mse=meta["running_mse"],
        best_psnr=-np.inf if meta["best_psnr"] is None else meta["best_psnr"],
        best_iteration=meta["best_iteration"],
        exposures=Exposures(**groups["exposures"]) if groups["exposures"] else None,
    )


def save_best(gaussians: FlatGaussians, folder: Path) -> None:
    """Write the Gaussians that did best so far to ``best.npz``."""
    with replacing(folder / "best.npz") as temporary:
        arrays: dict[str, Any] = {**row_arrays(gaussians)}
        np.savez(temporary, **arrays)


def load_best(folder: Path) -> FlatGaussians:
    """Read what :func:`save_best` wrote.

    Raises:
        CheckpointError: the file is missing or damaged.
    """
    path = folder / "best.npz"
    try:
        return from_row_arrays(FlatGaussians, _read_arrays(path))
    except _DAMAGE as error:
        raise CheckpointError(f"{path} cannot be read ({error}); train again without --resume.") from None


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    # Opened here, because numpy leaves a file open that turns out to be no archive.
    with path.open("rb") as handle, np.load(handle, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}
