"""Which format writes a path: every module of this package that calls `register` is found by itself."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from engine.files.format_table import FormatTable
from engine.files.options import ExportOptions
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


_TABLE: FormatTable[Exporter] = FormatTable(__name__.rpartition(".")[0], "export")


def register(exporter: Exporter) -> Exporter:
    """Add a format; its name must be new."""
    return _TABLE.register(exporter)


def exporters() -> tuple[Exporter, ...]:
    """All formats, by name."""
    return _TABLE.all()


def exporter_for(path: Path, format: str | None = None) -> Exporter:
    """The format called ``format``, or else the one that ``path``'s name asks for.

    ``.ply`` means a Gaussian PLY, except ``mesh.ply``, ``*.mesh.ply``, ``*_mesh.ply`` and ``*-mesh.ply``,
    which mean the octagon mesh. Upper and lower case are the same.

    Raises:
        SceneFileError: no format has that name or takes that file name; the text lists those that exist.
    """
    if format is not None:
        return _TABLE.named(format, path)
    return _TABLE.by_file_name(path, "no export format takes this file name")


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
