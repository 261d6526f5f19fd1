"""Check that what a command reads exists, before anything heavy is imported."""

import glob
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.settings.fields import iter_read_paths


def check_readable(path: Path) -> None:
    """Raise unless there is a file or folder at ``path``.

    Raises:
        SceneFileError: there is none, or it cannot be reached.
    """
    try:
        path.stat()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise SceneFileError(f"{path}: cannot be read ({reason}).") from None


def check_inputs(model: type[BaseModel], values: Mapping[str, Any]) -> None:
    """Raise unless all that a request would read exists; patterns of names are left to the operation.

    Args:
        model: class of the request.
        values: what is known of its fields, by name.

    Raises:
        SceneFileError: something is missing.
    """
    for path in iter_read_paths(model, values):
        if not glob.has_magic(str(path)):
            check_readable(path)
