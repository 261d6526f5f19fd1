"""Which format a file of Gaussians has: each module of this package that calls `register` is found by itself.

What a file begins with decides, then its name, so that a file under a wrong name is read all the same.
"""

import fnmatch
import importlib
import pkgutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from engine.errors import SceneFileError
from engine.events import Listener, StageFinished, StageStarted, ignore
from engine.gaussians.flattening import GaussianCloud, ImportReport, flatten
from engine.gaussians.model import FlatGaussians

HEAD_BYTES = 4096
FOLDER_FILES = ("scene.ply", "meta.json")
"""What a folder is read by: the scene of a run, or the description of an unpacked SOG."""

Reader = Callable[[Path], GaussianCloud]


@dataclass(frozen=True)
class Importer:
    """One format to read.

    Attributes:
        name: what ``format=`` calls it.
        patterns: file names that it takes, as in ``*.spz``; where two formats match, the pattern with more
            literal characters wins.
        description: one line for help texts.
        read: reads the Gaussians as the file has them, in the world frame of the 3DGS family (y down).
        recognises: whether a file that begins with these bytes (up to ``HEAD_BYTES``) is of this format.
    """

    name: str
    patterns: tuple[str, ...]
    description: str
    read: Reader
    recognises: Callable[[bytes], bool] = lambda _head: False


_IMPORTERS: dict[str, Importer] = {}


def register(importer: Importer) -> Importer:
    """Add a format; its name must be new."""
    if importer.name in _IMPORTERS:
        raise ValueError(f"an importer named '{importer.name}' is registered already")
    _IMPORTERS[importer.name] = importer
    return importer


def importers() -> tuple[Importer, ...]:
    """All formats, by name."""
    _discover()
    return tuple(_IMPORTERS[name] for name in sorted(_IMPORTERS))


def importer_for(path: Path, format: str | None = None) -> Importer:
    """The format called ``format``, or else the one that ``path``'s first bytes or its name show.

    Raises:
        SceneFileError: the file cannot be opened, or no format has that name, those bytes or that file name.
    """
    known = importers()
    if format is not None:
        by_name = {importer.name: importer for importer in known}
        if format not in by_name:
            names = ", ".join(by_name)
            raise SceneFileError(f"{path}: there is no import format '{format}'; choose one of {names}.")
        return by_name[format]
    head = _head(path)
    recognised = [importer for importer in known if importer.recognises(head)]
    if recognised:
        return recognised[0]
    matches = [
        (sum(character not in "*?" for character in pattern), importer)
        for importer in known
        for pattern in importer.patterns
        if fnmatch.fnmatchcase(path.name.lower(), pattern)
    ]
    if not matches:
        choices = "; ".join(f"{importer.name} ({', '.join(importer.patterns)})" for importer in known)
        raise SceneFileError(f"{path}: is no scene of a known format; the formats are {choices}.")
    return max(matches, key=lambda match: match[0])[1]


def read_scene(
    path: Path, format: str | None = None, *, drop_invalid: bool = False, listener: Listener = ignore
) -> tuple[FlatGaussians, ImportReport]:
    """Read the Gaussians of a file of any known format, or of the folder of a run, and flatten them.

    Args:
        path: the file, or a folder with ``scene.ply`` or with the ``meta.json`` of an unpacked SOG.
        format: the name of its format; by default the file shows it.
        drop_invalid: leave out Gaussians with values that are not finite, instead of refusing the file.
        listener: told when reading begins and ends (stage ``read``).

    Returns:
        Flat Gaussians, and what flattening and reading lost.

    Raises:
        SceneFileError: the file cannot be read; the text names it and says why.
    """
    source = _file_of(path)
    importer = importer_for(source, format)
    listener(StageStarted("read"))
    began = time.monotonic()
    cloud = importer.read(source)
    scene = flatten(cloud, source, drop_invalid=drop_invalid)
    listener(StageFinished("read", time.monotonic() - began))
    return scene


def _file_of(path: Path) -> Path:
    if not path.is_dir():
        return path
    for name in FOLDER_FILES:
        if (path / name).exists():
            return path / name
    raise SceneFileError(f"{path}: is a folder without a scene; it should hold {' or '.join(FOLDER_FILES)}.")


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as handle:
            return handle.read(HEAD_BYTES)
    except OSError as error:
        raise SceneFileError(f"{path}: cannot be read ({error.strerror or error}).") from error


@cache
def _discover() -> None:
    """Import every module of this package once; those that hold a format register it."""
    package = __name__.rpartition(".")[0]
    for module in pkgutil.iter_modules(importlib.import_module(package).__path__):
        importlib.import_module(f"{package}.{module.name}")
