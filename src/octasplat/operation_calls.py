"""Operations of the engine, done with the values that a caller gives in Python."""

import functools
import inspect
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, get_args, get_origin

from pydantic import BaseModel, BeforeValidator
from pydantic.fields import FieldInfo

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.events import EventListener
from octasplat.engine.operations.base import build_request
from octasplat.engine.operations.registry import operation
from octasplat.engine.operations.written_files import remember_written
from octasplat.engine.settings.fields import is_negatable
from octasplat.engine.settings.nearest_names import nearest_name
from octasplat.engine.settings.renamed_settings import replace_former_names
from octasplat.notebook import default_progress

P = ParamSpec("P")
R = TypeVar("R")


class UnknownOption(ConfigError, TypeError):
    """A function was called with an option that it does not have."""


def names_checked(function: Callable[P, R]) -> Callable[P, R]:
    """Return the function, which refuses an option that it does not have and offers the nearest name.

    Names of the last version are read, see :mod:`octasplat.engine.settings.renamed_settings`.

    Raises:
        UnknownOption: when it is called with one.
    """
    names = tuple(inspect.signature(function).parameters)

    @functools.wraps(function)
    def call(*values: P.args, **options: P.kwargs) -> R:
        former = [name for name in options if name not in names]
        # Only the verbs have requests, which know their former names.
        if former and function.__module__ == "octasplat.verbs":
            request = operation(function.__name__.rstrip("_").replace("_", "-")).request
            renamed = replace_former_names((request,), {name: options.pop(name) for name in former})
            options.update(renamed)
        for name in options:
            if name not in names:
                nearest = nearest_name(name, names)
                more = f"the nearest is {nearest}" if nearest else "help() of it lists all"
                raise UnknownOption(f"{function.__name__} has no option '{name}'; {more}.")
        return function(*values, **options)

    return call


def run_operation(
    name: str,
    values: Mapping[str, Any],
    progress: EventListener | None,
    should_stop: Callable[[], bool],
    threads: int,
) -> Any:
    """Return the result of an operation.

    Args:
        name: of the operation.
        values: those of its request by field; for what counts as given see :func:`explicit_values`.
        progress: told the events; None logs them, or shows them in a notebook.
        should_stop: asked now and then; True ends the work with ``CancelledError``.
        threads: 0 takes all cores.

    Raises:
        ConfigError: a value cannot be used; the sentence is that of the command.
        OctasplatError: as the operation does.
    """
    check_threads(threads)
    verb = operation(name)
    request = build_request(verb.request, explicit_values(verb.request, values))
    result = verb.execute(
        request, progress=progress or default_progress(), should_stop=should_stop, threads=threads
    )
    remember_written(name, result.files)
    return result


def check_threads(threads: int) -> None:
    """Refuse what is no number of threads.

    Raises:
        ConfigError: it is below 0, or not whole.
    """
    if not hasattr(threads, "__index__"):
        raise ConfigError(f"threads: must be a whole number, 0 for all cores (it is {threads!r}).")
    if threads < 0:
        raise ConfigError(f"threads: must be 0, which takes all cores, or more (it is {threads}).")


def explicit_values(model: type[BaseModel], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return those values of a model's fields that a caller gave, as the model takes them.

    None counts as not given, and so does a boolean that is the default, unless it can be said. One value
    where several may be given counts as the only one.
    """
    fields = model.model_fields
    return {
        name: _as_several(fields[name], _to_plain_value(value))
        for name, value in values.items()
        if value is not None
        and not (isinstance(value, bool) and value is fields[name].default and not is_negatable(fields[name]))
    }


def _as_several(field: FieldInfo, value: Any) -> Any:
    """Return a value alone as the only one of a field that takes any number of them."""
    # Such a field reads texts by itself.
    if any(isinstance(mark, BeforeValidator) for mark in field.metadata):
        return value
    for annotation in (field.annotation, *get_args(field.annotation)):
        inner = get_args(annotation)
        if get_origin(annotation) is not tuple or inner[-1:] != (Ellipsis,):
            continue
        # Of a list of pairs, such as axes and angles, one pair is a tuple itself.
        is_pair = get_origin(inner[0]) is tuple and isinstance(value, tuple) and len(value) > 0
        if isinstance(value, str | Path) or (is_pair and not isinstance(value[0], tuple)):
            return (value,)
    return value


def _to_plain_value(value: Any) -> Any:
    """Return the value with paths of any kind as such, and arrays as lists."""
    if isinstance(value, os.PathLike):
        return Path(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, list | tuple):
        return tuple(_to_plain_value(part) for part in value)
    return value
