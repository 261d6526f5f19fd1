"""Names of files that are written beside a run's own results."""

import re
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator

from octasplat.engine.errors import SceneFileError
from octasplat.engine.files.registry import exporter_for

_FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
_TAKEN = frozenset(
    {"scene.ply", "config.json", "held_out.json", "views.json", "events.jsonl", "metrics.json", "report.html"}
    | {"training.json", "plan.json", "environment.hdr", "background.exr", "edits.json", "renders", "layers"}
    | {"cache", "checkpoints", "poses"}
)  # fmt: skip


def check_export_name(name: str) -> str:
    """Return a file name of a result, whose format is known; raise ValueError otherwise."""
    if not _FILE_NAME.fullmatch(name) or ".." in name:
        raise ValueError("name a file such as mesh.glb: letters, digits, '.', '_' and '-'")
    if name.lower() in _TAKEN:
        raise ValueError(f"{name} is the name of another result")
    try:
        exporter_for(Path(name))
    except SceneFileError as error:
        raise ValueError(str(error)) from None
    return name


ExportName = Annotated[str, AfterValidator(check_export_name)]
