"""Which format writes a path: every module of this package that calls `register` is found by itself."""

import fnmatch
import importlib
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from engine.errors import SceneFileError
from engine.export.options import ExportOptions
from engine.gaussians.model import FlatGaussians

Writer = Callable[[FlatGaussians, Path, ExportOptions], tuple[Path, ...]]


@dataclass(frozen=True)
class Exporter:
    """One export format.

    Attributes:
        name: what ``format=`` calls it.
        patterns: file names that it takes by default, as in ``*.glb``; where two formats match, the pattern
            with more literal characters wins.
        description: one line for help texts.
        write: writes the Gaussians to the path and returns every file written, the path itself first.
    """

    name: str
    patterns: tuple[str, ...]
    description: str
    write: Writer


_EXPORTERS: dict[str, Exporter] = {}


def register(exporter: Exporter) -> Exporter:
    """Add a format; its name must be new."""
    if exporter.name in _EXPORTERS:
        raise ValueError(f"an exporter named '{exporter.name}' is registered already")
    _EXPORTERS[exporter.name] = exporter
    return exporter


def exporters() -> tuple[Exporter, ...]:
    """All formats, by name."""
    _discover()
    return tuple(_EXPORTERS[name] for name in sorted(_EXPORTERS))


def exporter_for(path: Path, format: str | None = None) -> Exporter:
    """The format called ``format``, or else the one that ``path``'s name asks for.

    ``.ply`` means a Gaussian PLY, except ``mesh.ply``, ``*.mesh.ply``, ``*_mesh.ply`` and ``*-mesh.ply``,
    which mean the octagon mesh. Upper and lower case are the same.

    Raises:
        SceneFileError: no format has that name or takes that file name; the text lists those that exist.
    """
    known = exporters()
    if format is not None:
        by_name = {exporter.name: exporter for exporter in known}
        if format not in by_name:
            names = ", ".join(by_name)
            raise SceneFileError(f"{path}: there is no export format '{format}'; choose one of {names}.")
        return by_name[format]
    matches = [
        (sum(character not in "*?" for character in pattern), exporter)
        for exporter in known
        for pattern in exporter.patterns
        if fnmatch.fnmatchcase(path.name.lower(), pattern)
    ]
    if not matches:
        choices = "; ".join(f"{exporter.name} ({', '.join(exporter.patterns)})" for exporter in known)
        raise SceneFileError(f"{path}: no export format takes this file name; the formats are {choices}.")
    return max(matches, key=lambda match: match[0])[1]


def export_scene(
    gaussians: FlatGaussians, path: Path, options: ExportOptions | None = None, format: str | None = None
) -> tuple[Path, ...]:
    """Write ``gaussians`` to ``path`` in the format that its name or ``format`` says.

    Returns:
        Every file written, ``path`` first.

    Raises:
        SceneFileError: no such format, nothing to write, values that are not finite, or a file that cannot be
            written.
    """
    return exporter_for(path, format).write(gaussians, path, options or ExportOptions())


@cache
def _discover() -> None:
    """Import every module of this package once; those that hold a format register it."""
    package = __name__.rpartition(".")[0]
    for module in pkgutil.iter_modules(importlib.import_module(package).__path__):
        importlib.import_module(f"{package}.{module.name}")
