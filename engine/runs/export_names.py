"""Names of the files that a reconstruction writes besides its scene."""

import re
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, BeforeValidator

from octasplat.engine.core.errors import SceneFileError

_FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
_TAKEN = frozenset(
    {"scene.ply", "config.json", "held_out.json", "views.json", "events.jsonl", "metrics.json", "report.html"}
    | {"training.json", "plan.json", "environment.hdr", "environment.exr", "background.exr", "edits.json"}
    | {"residual.npz"}
    | {"georeference.json"}
    | {"renders", "layers", "cache", "checkpoints", "poses", "blocks", "start"}
)  # fmt: skip


def check_export_name(name: str) -> str:
    """Return the file name if its format is known and no other result has it; raise ValueError otherwise."""
    from octasplat.engine.files import exporter_for

    if not _FILE_NAME.fullmatch(name) or ".." in name:  # the name becomes a path in the run's folder
        raise ValueError("name a file such as viewer.glb: letters, digits, '.', '_' and '-'")
    if name.lower() in _TAKEN:
        raise ValueError(f"{name} is the name of another result")
    try:
        exporter_for(Path(name))
    except SceneFileError as error:
        raise ValueError(str(error)) from None
    return name


def split_names(value: object) -> object:
    """Return the names of a text such as ``viewer.glb,scene.spz``, each once; anything else as it is."""
    if not isinstance(value, str):
        return value
    return tuple(dict.fromkeys(filter(None, (part.strip() for part in value.split(",")))))


ExportName = Annotated[str, AfterValidator(check_export_name)]
"""Name of a file whose format is known."""
ExportNames = Annotated[
    tuple[ExportName, ...],
    BeforeValidator(split_names, json_schema_input_type=tuple[ExportName, ...]),
]
"""Names of files, or a text with commas between them."""
