"""What a job's program has written, published as results of the job."""

import json
import os
from pathlib import Path

from octasplat.engine.core.writing import write_json
from octasplat.engine.runs.run_folder import CONFIG, EVENTS, REPORT
from octasplat.workers.worker.path_redaction import PathRedactor
from octasplat.workers.worker.task import INFO_FILE, Task


def path_redactor(task: Task) -> PathRedactor:
    """Return what takes the paths of this machine out of a job's texts."""
    return PathRedactor(task.folder, task.scene.parents[2] if task.scene is not None else task.folder)


def publish_file(task: Task, path: Path, name: str) -> None:
    """Add a file to the results without a copy."""
    target = task.results / name
    target.parent.mkdir(parents=True, exist_ok=True)
    # os.link refuses an existing name, which an earlier call of the same attempt has left.
    target.unlink(missing_ok=True)
    if name == CONFIG:  # where the photographs lay on this machine is private
        content = json.loads(path.read_text(encoding="utf-8"))
        write_json(target, {**content, "scene": task.title})
    elif name in (EVENTS, REPORT, INFO_FILE):
        target.write_text(
            path_redactor(task).replace_job_paths(path.read_text(encoding="utf-8")), encoding="utf-8"
        )
    else:
        os.link(path, target)
