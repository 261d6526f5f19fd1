"""Which format a file of Gaussians has: each module of this package that calls `register` is found by itself.

What a file begins with decides, then its name, so that a file under a wrong name is read all the same.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from engine.errors import SceneFileError
from engine.events import Listener, StageFinished, StageStarted, ignore
from engine.files.format_table import FormatTable
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


_TABLE: FormatTable[Importer] = FormatTable(__name__.rpartition(".")[0], "import")


def register(importer: Importer) -> Importer:
    """Add a format; its name must be new."""
    return _TABLE.register(importer)


def importers() -> tuple[Importer, ...]:
    """All formats, by name."""
    return _TABLE.all()


def importer_for(path: Path, format: str | None = None) -> Importer:
    """The format called ``format``, or else the one that ``path``'s first bytes or its name show.

    Raises:
        SceneFileError: the file cannot be opened, or no format has that name, those bytes or that file name.
    """
    if format is not None:
        return _TABLE.named(format, path)
    head = _head(path)
    for importer in importers():
        if importer.recognises(head):
            return importer
    return _TABLE.by_file_name(path, "is no scene of a known format")


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
