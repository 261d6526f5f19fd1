"""The files of a scene's photographs on disk."""

import os
from collections.abc import Iterator
from pathlib import Path

from octasplat.engine.core.relative_paths import normalize_name
from octasplat.engine.core.scene_layout import ARCHIVE_SUFFIXES, IMAGES, is_ignored_file, is_photograph
from octasplat.engine.dataset.results_among import is_run_folder

_PHOTOGRAPH_FOLDERS = ("images", "input")


def no_folder_sentence(scene: Path) -> str:
    """Return what to say where a scene is to be a folder and is none, as a ZIP file that jobs would take."""
    if scene.is_file() and scene.suffix.lower() in ARCHIVE_SUFFIXES:
        return f"{scene} is an archive; unpack it and name its folder, or octasplat submit it to a service."
    return f"{scene} is not a folder; name the folder that holds the photographs."


def image_folder(root: Path) -> Path:
    """Return ``images/`` or ``input/`` of a scene, or the scene itself where neither holds photographs."""
    folders = [root / name for name in _PHOTOGRAPH_FOLDERS if (root / name).is_dir()]
    elsewhere = root if not folders or _holds_photographs(root) else folders[0]
    return next(
        (folder for folder in folders if not is_run_folder(folder) and _holds_photographs(folder)), elsewhere
    )


def _holds_photographs(folder: Path) -> bool:
    """Return whether photographs lie in a folder that are no results of a run below it."""
    return any(
        is_photograph(_within(folder) + name) and not is_ignored_file(name) for name in files_below(folder)
    )


def _within(folder: Path) -> str:
    """Return what names of files in ``folder`` begin with in a scene: images/depth/ holds no depth maps."""
    return IMAGES if folder.name in _PHOTOGRAPH_FOLDERS else ""


def files_below(folder: Path) -> dict[str, Path]:
    """Return files by their NFC-normalised path below ``folder``, without hidden ones and results of runs."""
    # File systems differ in how they spell an umlaut; models come from other machines.
    return {normalize_name(path.relative_to(folder).as_posix()): path for path in _walk(folder, frozenset())}


def _walk(folder: Path, above: frozenset[str]) -> Iterator[Path]:
    """Yield the files below a folder, sorted; ``above`` has where the folders lie that it was reached by."""
    place = os.path.realpath(folder)
    # A link back to one of these would show every photograph again, as often as links may be followed.
    if place in above:
        return
    try:
        with os.scandir(folder) as found:
            entries = sorted((entry for entry in found if not entry.name.startswith(".")), key=_by_name)
    except OSError:
        return
    for entry in entries:
        path = folder / entry.name
        if not path.is_dir():
            yield path
        elif not is_run_folder(path):
            yield from _walk(path, above | {place})


def _by_name(entry: os.DirEntry[str]) -> str:
    return entry.name


def photographs_below(folder: Path) -> dict[str, Path]:
    """Return photographs by their NFC-normalised path below ``folder``, of the formats that are taken."""
    top = _within(folder)
    return {name: path for name, path in files_below(folder).items() if is_photograph(top + name)}
