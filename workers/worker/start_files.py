"""What a job that begins with another takes of it: the scene, or the newest checkpoint of its training."""

import re
from collections.abc import Iterable, Sequence

from octasplat.workers.db.rows import Artifact, Job
from octasplat.workers.storage.trees import TreeFile
from octasplat.workers.worker.checkpoint import Checkpoint
from octasplat.workers.worker.task import POSES_FOLDER, RUN_FOLDER, SCENE_FILE

_CHECKPOINT = re.compile(r"checkpoints/iteration_\d+\.npz")
_VIEWS_FILE = "views.json"
START_RECORD = f"{RUN_FOLDER}/start/start.json"
"""In the folder of an attempt, the last file of the engine's copy of what a run begins with."""


def start_choices(source: Job, artifacts: Sequence[Artifact]) -> list[list[TreeFile]]:
    """Return what a job may begin with, as files by their names in a run folder; the newest state first.

    A job that did not succeed goes by its checkpoint: results that it has may be those of an earlier attempt.
    None of the choices is without Gaussians, so that there may be none.

    Args:
        source: the job to begin with.
        artifacts: its results.
    """
    kept = () if source.checkpoint is None else Checkpoint.from_row(source.checkpoint).files
    below = f"{RUN_FOLDER}/"
    run = [
        file.model_copy(update={"path": file.path.removeprefix(below)})
        for file in kept
        if file.path.startswith(below)
    ]
    results = [TreeFile(path=row.name, sha256=row.sha256, size_bytes=row.size_bytes) for row in artifacts]
    return [chosen for files in (run, results) if (chosen := _needed(files))]


def _needed(files: Iterable[TreeFile]) -> list[TreeFile]:
    """Return those files of a run that another begins with; none where no Gaussians are among them."""
    by_name = {file.path: file for file in files}
    newest = max((name for name in by_name if _CHECKPOINT.fullmatch(name)), default=None)
    if newest is None and SCENE_FILE not in by_name:
        return []
    wanted = (SCENE_FILE, _VIEWS_FILE, newest)
    return [file for name, file in by_name.items() if name in wanted or name.startswith(f"{POSES_FOLDER}/")]
