"""Files of an attempt's folder from which a later one resumes, and whether its poses are being exchanged."""

import re
from collections.abc import Iterator
from pathlib import Path

from octasplat.engine.core.writing import former_folder
from octasplat.engine.poses.stored_search import (
    STORED_DATABASE,
    STORED_MAPPINGS,
    STORED_SEARCH_FILES,
    search_folder,
)
from octasplat.workers.storage.untrusted_folder import UntrustedFolder
from octasplat.workers.worker.start_files import START_RECORD
from octasplat.workers.worker.task import BLOCKS_FOLDER, POSES_FOLDER, RUN_FOLDER

_CHECKPOINT = re.compile(r"run/checkpoints/iteration_\d+\.npz")
_RESIDUAL = "run/residual.npz"
_CHECKPOINT_FILES = (
    "run/config.json", "run/held_out.json", "run/views.json", "run/events.jsonl", "run/training.json",
    "run/plan.json", "run/georeference.json", "run/scene.ply", "run/checkpoints/best.npz",
    "run/background.exr", "run/environment.exr", "run/environment.hdr", _RESIDUAL,
    "run/start/best.npz", "run/start/views.json", START_RECORD,
)  # fmt: skip
_SEARCH_FILES = tuple(
    f"{RUN_FOLDER}/{search_folder(Path(POSES_FOLDER)).name}/{name}" for name in STORED_SEARCH_FILES
)
_BLOCKS = f"{RUN_FOLDER}/{BLOCKS_FOLDER}"
_BLOCK = re.compile(r"block_\d+")
"""The pieces of which each has a job of its own."""
_POSES = f"{RUN_FOLDER}/{POSES_FOLDER}"
_FORMER_POSES = former_folder(Path(_POSES)).as_posix()


def poses_state(folder: UntrustedFolder) -> tuple[int, ...] | None:
    """Return what tells the folder of poses from any other one, or from none; None while it is exchanged."""
    state = folder.state(_POSES)
    if state is None and folder.state(_FORMER_POSES) is not None:
        # the second of two renames may have come between
        return folder.state(_POSES)
    return state or ()


def checkpoint_files(folder: UntrustedFolder, stage: str, own_block: str | None) -> list[str]:
    """Return the names of the files of a reconstruction; none if there is nothing yet.

    Args:
        folder: of the attempt.
        stage: of the work.
        own_block: the block of its job; None for the whole.
    """
    names = [name for name in _CHECKPOINT_FILES if folder.is_file(name)]
    # further models lie in folders below
    poses = sorted(f"{_POSES}/{name}" for name in folder.names(_POSES))
    checkpoints = _directly_below(folder, f"{RUN_FOLDER}/checkpoints")
    pieces = list(_piece_files(folder, own_block))
    search = [name for name in _SEARCH_FILES if folder.is_file(name)]
    if own_block is not None:  # all else is the whole job's
        return pieces
    names += [*poses, *pieces]
    if "run/scene.ply" in names:  # the training is done, its checkpoints are of no more use
        return [name for name in names if name == _RESIDUAL or not name.endswith(".npz")]
    newest = max((name for name in checkpoints if _CHECKPOINT.fullmatch(name)), default=None)
    if newest is not None:
        return [*names, newest]
    if search and not poses:
        # The first of two searches may have ended, whose state an earlier checkpoint has.
        is_new = stage != "poses" or any(name.endswith(STORED_MAPPINGS) for name in search)
        has_state = is_new and any(name.endswith(STORED_DATABASE) for name in search)
        return [*names, *search] if has_state else []
    return names if poses or pieces else []


def _piece_files(folder: UntrustedFolder, own_block: str | None) -> Iterator[str]:
    """Yield the files of a run in blocks from which an attempt goes on, the newest checkpoint of each piece.

    Args:
        folder: of the attempt.
        own_block: the block of its job; None for the whole, which goes without those of its blocks.
    """
    newest: dict[str, str] = {}
    for name in sorted(folder.names(_BLOCKS)):
        piece, _, rest = name.partition("/")
        if (piece != own_block) if own_block is not None else _BLOCK.fullmatch(piece):
            continue
        if not rest or rest in ("best.npz", "piece.json"):
            yield f"{_BLOCKS}/{name}"
        elif re.fullmatch(r"checkpoints/(iteration_\d+|best)\.npz", rest):
            newest[f"{piece}/{'best' if rest.endswith('best.npz') else 'iteration'}"] = name
    yield from (f"{_BLOCKS}/{name}" for name in newest.values())


def _directly_below(folder: UntrustedFolder, below: str) -> list[str]:
    """Return the names, relative to ``folder``, of the files of one of its folders."""
    return [f"{below}/{name}" for name in folder.names(below) if "/" not in name]
