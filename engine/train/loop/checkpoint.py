"""Checkpoints: everything that the rest of a run depends on, in one file, written whole or not at all."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from octasplat.engine.core import versions
from octasplat.engine.core.archive_damage import ARCHIVE_DAMAGE
from octasplat.engine.core.errors import CheckpointError, DamagedCheckpointError
from octasplat.engine.core.events import EventListener, Warned
from octasplat.engine.core.writing import atomic_replace
from octasplat.engine.dataset import Dataset
from octasplat.engine.gaussians.model import FlatGaussians
from octasplat.engine.gaussians.rows import from_row_arrays, row_arrays
from octasplat.engine.settings.base import dump_with_former_settings
from octasplat.engine.train.config import TrainConfig
from octasplat.engine.train.loop.state import TrainState
from octasplat.engine.train.optimization.adam import Adam
from octasplat.engine.train.optimization.weight_averaging import WeightAverage

CHECKPOINT_FORMAT = 6
KEPT_CHECKPOINTS = 2
_PREFIX, _BEST = "iteration_", "best.npz"
_GROUPS = ("gaussians", "adam", "average", "densifier", "shading", "poses")


def run_fingerprint(dataset: Dataset, config: TrainConfig) -> str:
    """Return a digest of the settings and the photographs that decide every byte of a training."""
    # settings under their former names, so that older checkpoints keep their digest
    parts: list[object] = [dump_with_former_settings(config), dataset.views_record.fingerprint()]
    if dataset.region is not None:
        parts.append(dataset.region.corners_world)
    text = json.dumps(parts)
    return hashlib.sha256(text.encode()).hexdigest()


def checkpoint_path(folder: Path, iteration: int) -> Path:
    """Return the path of the checkpoint of ``iteration``."""
    return folder / f"{_PREFIX}{iteration:07d}.npz"


def latest_checkpoint(folder: Path) -> Path | None:
    """Return the newest checkpoint of a run, or None."""
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
        "format": CHECKPOINT_FORMAT,
        versions.STATED: versions.RESULTS_VERSION,
        "fingerprint": fingerprint,
        "iteration": state.iteration,
        "rng": state.rng.bit_generator.state,
        "seconds": state.seconds,
        "running_mse": state.running_mse,
        "best_psnr": state.best_psnr if np.isfinite(state.best_psnr) else None,  # JSON has no infinity
        "best_iteration": state.best_iteration,
        # Keys of former versions, whose checkpoints are read.
        "left_out": state.excluded_views.tolist(),
        "probed": state.probes,
        "hastened_after": state.early_stop_at,
        "taken_near": state.pruned_near_cameras,
        "averaged": state.average.count,
    }
    arrays: dict[str, Any] = {
        f"gaussians.{name}": array for name, array in row_arrays(state.gaussians).items()
    }
    arrays |= {f"adam.{name}": array for name, array in row_arrays(state.adam).items()}
    if state.average.gaussians is not None:
        arrays |= {f"average.{name}": array for name, array in row_arrays(state.average.gaussians).items()}
    arrays |= {f"densifier.{name}": value for name, value in state.densifier.items()}
    arrays |= {f"shading.{name}": value for name, value in state.shading.items()}
    if len(state.pose_corrections):
        arrays["poses.corrections"] = state.pose_corrections
    meta["arrays"] = sorted(arrays)  # listed, so that a missing array is noticed
    with atomic_replace(path) as temporary:
        np.savez(temporary, meta=np.array(json.dumps(meta)), **arrays)
    for partial in folder.glob(".*.partial.npz"):  # of runs that were killed while they wrote
        partial.unlink()
    for old in sorted(folder.glob(f"{_PREFIX}*.npz"))[:-KEPT_CHECKPOINTS]:
        old.unlink()
    return path


def load_checkpoint(path: Path, fingerprint: str | None = None) -> TrainState:
    """Read a checkpoint back.

    Args:
        path: the file.
        fingerprint: of the settings and photographs that it must belong to; None takes any.

    Raises:
        DamagedCheckpointError: the file cannot be read.
        CheckpointError: it belongs to another configuration or other photographs.
    """
    try:
        arrays = _read_arrays(path)
        meta = json.loads(str(arrays.pop("meta")))
        is_other = fingerprint is not None and meta["fingerprint"] != fingerprint
        if meta.get("format") != CHECKPOINT_FORMAT or is_other:
            raise CheckpointError(
                f"{path} belongs to other settings or other photographs; "
                "give the settings it was made with, or choose another output folder."
            )
        if sorted(arrays) != meta["arrays"]:
            raise ValueError("arrays are missing")
        groups = _group_arrays(arrays)
    except ARCHIVE_DAMAGE as error:
        raise DamagedCheckpointError(
            f"{path} is damaged ({error}); the one before it is taken, or the run begins anew."
        ) from None
    rng = np.random.Generator(np.random.PCG64())
    rng.bit_generator.state = meta["rng"]
    mean = from_row_arrays(FlatGaussians, groups["average"]) if groups["average"] else None
    return TrainState(
        iteration=meta["iteration"],
        gaussians=from_row_arrays(FlatGaussians, groups["gaussians"]),
        adam=from_row_arrays(Adam, groups["adam"]),
        rng=rng,
        densifier=groups["densifier"],
        shading=groups["shading"],
        seconds=meta["seconds"],
        running_mse=meta["running_mse"],
        best_psnr=-np.inf if meta["best_psnr"] is None else meta["best_psnr"],
        best_iteration=meta["best_iteration"],
        excluded_views=np.array(meta["left_out"], np.int64),
        probes=[(iteration, psnr) for iteration, psnr in meta["probed"]],
        early_stop_at=meta["hastened_after"],
        pruned_near_cameras=meta["taken_near"],
        pose_corrections=groups["poses"].get("corrections", np.zeros((0, 6))),
        average=WeightAverage(mean, meta["averaged"]),
    )


def load_latest_checkpoint(folder: Path, fingerprint: str, progress: EventListener) -> TrainState | None:
    """Return the newest checkpoint, if there is any; a damaged one is removed, and the one before is read.

    Those of a version with other results are removed, see :func:`remove_former_checkpoints`.

    Raises:
        CheckpointError: it belongs to another configuration or other photographs.
    """
    remove_former_checkpoints(folder, progress)
    while (path := latest_checkpoint(folder)) is not None:
        try:
            return load_checkpoint(path, fingerprint)
        except DamagedCheckpointError as error:
            progress(Warned(str(error)))
            path.unlink()
    return None


def remove_former_checkpoints(folder: Path, progress: EventListener) -> bool:
    """Remove checkpoints of a version in which the same settings gave other results, so that none are mixed.

    Args:
        folder: of the checkpoints.
        progress: told that the training begins anew.

    Returns:
        Whether there were any.
    """
    former = [path for path in sorted(folder.glob(f"{_PREFIX}*.npz")) if not _has_same_results(path)]
    if not former:
        return False
    progress(
        Warned(
            f"The training in {folder.parent} was begun by a version in which the same settings gave other "
            "results, so it begins anew."
        )
    )
    for path in (folder / _BEST, *former):
        path.unlink(missing_ok=True)
    return True


def _has_same_results(path: Path) -> bool:
    """Return whether a checkpoint is of a version with the same results; True where it is damaged."""
    try:
        with path.open("rb") as handle, np.load(handle, allow_pickle=False) as archive:
            return versions.has_same_results(json.loads(str(archive["meta"])))
    except ARCHIVE_DAMAGE:
        return True  # told when it is read


@dataclass(frozen=True)
class BestState:
    """The state that did best so far.

    Attributes:
        gaussians: the Gaussians.
        shading: state of the shading model then.
        pose_corrections: of all views then, as in the training's state; no rows where poses are not refined.
    """

    gaussians: FlatGaussians
    shading: Mapping[str, np.ndarray]
    pose_corrections: Float64[np.ndarray, "v 6"] = field(default_factory=lambda: np.zeros((0, 6)))


def save_best(best: BestState, folder: Path) -> None:
    """Write the state that did best so far to ``best.npz``."""
    arrays: dict[str, Any] = {
        f"gaussians.{name}": array for name, array in row_arrays(best.gaussians).items()
    }
    arrays |= {f"shading.{name}": value for name, value in best.shading.items()}
    arrays["poses.corrections"] = best.pose_corrections
    with atomic_replace(folder / _BEST) as temporary:
        np.savez(temporary, **arrays)


def load_best(folder: Path) -> BestState:
    """Read what :func:`save_best` wrote.

    Raises:
        CheckpointError: the file is missing or damaged.
    """
    path = folder / _BEST
    try:
        groups = _group_arrays(_read_arrays(path))
        gaussians = from_row_arrays(FlatGaussians, groups["gaussians"])
        return BestState(gaussians, groups["shading"], groups["poses"]["corrections"])
    except ARCHIVE_DAMAGE as error:
        raise CheckpointError(f"{path} cannot be read ({error}); train again without --resume.") from None


def _group_arrays(arrays: Mapping[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """Return arrays by what comes before the first dot of their names, then by the rest."""
    groups: dict[str, dict[str, np.ndarray]] = {name: {} for name in _GROUPS}
    for name, array in arrays.items():
        group, _, key = name.partition(".")
        groups[group][key] = array
    return groups


def _read_arrays(path: Path) -> dict[str, np.ndarray]:
    # Opened here, because numpy leaves a file open that turns out to be no archive.
    with path.open("rb") as handle, np.load(handle, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}
