"""Formats of an index and folders of parts beside it: parts of before are replaced, and nothing else."""

import os
import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

from octasplat.engine.core.errors import OctasplatError, SceneFileError
from octasplat.engine.core.writing import report_disk_full


def former_folders(
    path: Path, names_in: Callable[[Path], Iterable[str]], holds_parts: Callable[[frozenset[str]], bool]
) -> frozenset[str]:
    """Return those of the folders beside an index that hold its parts, and nothing that somebody put there.

    Args:
        path: the index.
        names_in: returns the folders that an index names; none where it cannot be read. It is asked of the
            index of before, and of those that a process has left which was stopped while it moved folders.
        holds_parts: whether files of these names, all that a folder has, are parts.
    """

    def is_former(folder: Path) -> bool:
        return folder.is_dir() and holds_parts(frozenset(file.name for file in folder.iterdir()))

    names = {name for index in (path, *_hidden_indices(path)) for name in names_in(index)}
    return frozenset(name for name in names if is_former(path.parent / name))


def move_into_place(index: Path, path: Path, former: frozenset[str]) -> tuple[Path, ...]:
    """Move the folders beside ``index`` to the place of ``path``, then the index; return all files, it first.

    Where the disk is full all stays as it was. A process that is stopped meanwhile leaves no index, and the
    next one may replace what is there.

    Args:
        index: as it was written, in a folder of its own on the disk of ``path``.
        path: where it goes; its folder is there.
        former: folders there that are replaced, by :func:`former_folders`; others of these names are not.

    Raises:
        SceneFileError: a folder of such a name is there that is no part of the index.
        OSError: a file cannot be moved.
    """
    folders = sorted(folder for folder in index.parent.iterdir() if folder.is_dir())
    for folder in folders:
        if (path.parent / folder.name).exists() and folder.name not in former:
            raise SceneFileError(
                f"{path}: not written, as {path.parent / folder.name} is there already and no part of it; "
                "name a file in a folder of its own."
            )
    pending, replaced = _hidden_indices(path)
    _copy_index(index, pending)
    if path.exists():
        path.replace(replaced)  # from now on it would name what is not there
    # whole folders are moved: of one that is removed file by file nobody could tell what it was
    removed = index.parent / ".former"
    removed.mkdir()
    for name in former:
        shutil.move(path.parent / name, removed / name)
    moved: list[Path] = []
    for folder in folders:
        target = path.parent / folder.name
        shutil.move(folder, target)
        moved += sorted(file for file in target.rglob("*") if file.is_file())
    pending.replace(path)
    replaced.unlink(missing_ok=True)
    return (path, *moved)


def _hidden_indices(path: Path) -> tuple[Path, Path]:
    """Return the places of an index whose folders are being moved, and of that of before."""
    return path.with_name(f".{path.name}.pending"), path.with_name(f".{path.name}.former")


def _copy_index(index: Path, copy: Path) -> None:
    """Copy an index, durably.

    Raises:
        DiskFullError: there is no room for it; no copy is left.
    """
    try:
        with report_disk_full(copy):
            shutil.copyfile(index, copy)
            with copy.open("r+b") as handle:
                os.fsync(handle.fileno())
    except OctasplatError:
        copy.unlink(missing_ok=True)
        raise
