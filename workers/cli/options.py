"""Options that several commands share."""

from collections.abc import Callable
from typing import Any, TypeVar

import click

from octasplat.engine.core.errors import ConfigError
from octasplat.engine.core.threads import available_threads

F = TypeVar("F", bound=Callable[..., Any])


def _cap_to_cores(_context: click.Context, _parameter: click.Parameter, value: int) -> int:
    return min(value, available_threads())


def threads_option(command: F) -> F:
    """Add the option ``--threads``; the command gets no more threads than there are cores."""
    return click.option(
        "--threads",
        type=click.IntRange(min=0),
        default=0,
        callback=_cap_to_cores,
        metavar="N",
        help="Threads to use; 0 (the default) takes all cores.",
    )(command)


def parse_export_names(text: str | None) -> tuple[str, ...] | None:
    """Return the names in ``viewer.glb,scene.spz``; None where nothing was given.

    Raises:
        ConfigError: one of them is no name of a result.
    """
    from octasplat.engine.runs.export_names import check_export_name

    if text is None:
        return None
    names = tuple(dict.fromkeys(filter(None, (part.strip() for part in text.split(",")))))
    for name in names:
        try:
            check_export_name(name)
        except ValueError as error:
            raise ConfigError(f"--exports {name}: {error}.") from None
    return names


def exports_option(command: F) -> F:
    """Add the option ``--exports``."""
    return click.option(
        "--exports",
        metavar="NAMES",
        help="Files to write besides scene.ply, e.g. viewer.glb,scene.spz; see octasplat export --help.",
    )(command)
