"""Operations of the engine, done with the values that a caller gives in Python."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from octasplat.engine.events import Listener
from octasplat.engine.operations.base import build
from octasplat.engine.operations.registry import operation
from octasplat.notebook import default_listener


def run_operation(
    name: str,
    values: Mapping[str, Any],
    progress: Listener | None,
    should_stop: Callable[[], bool],
    threads: int,
) -> Any:
    """Return the result of an operation.

    Args:
        name: of the operation.
        values: those of its request by field; None, and a boolean that is the default, count as not given.
        progress: told the events; None logs them, or shows them in a notebook.
        should_stop: asked now and then; True ends the work with ``Cancelled``.
        threads: 0 takes all cores.

    Raises:
        ConfigError: a value cannot be used; the sentence is that of the command.
        OctasplatError: as the operation does.
    """
    verb = operation(name)
    request = build(verb.request, given_values(verb.request, values))
    return verb.run(
        request, progress=progress or default_listener(), should_stop=should_stop, threads=threads
    )


def given_values(model: type[BaseModel], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return those values of a model's fields that a caller gave, as the model takes them."""
    fields = model.model_fields
    return {
        name: _plain(value)
        for name, value in values.items()
        if value is not None and not (isinstance(value, bool) and value is fields[name].default)
    }


def _plain(value: Any) -> Any:
    """The value with paths of any kind as such, and arrays as lists."""
    if isinstance(value, os.PathLike):
        return Path(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, list | tuple):
        return tuple(_plain(part) for part in value)
    return value
