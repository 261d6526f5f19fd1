"""Formats of an index and folders of parts beside it: parts of before are replaced, and nothing else."""

import shutil
from collections.abc import Callable, Iterable
from pathlib import Path

from octasplat.engine.core.errors import SceneFileError
from octasplat.engine.core.writing import atomic_replace


def former_folders(
    path: Path, names: Iterable[str], holds_parts: Callable[[frozenset[str]], bool]
) -> frozenset[str]:
    """Return those of the folders beside an index that hold its parts, and nothing that somebody put there.

    Args:
        path: the index.
        names: folders that the index of before names.
        holds_parts: whether files of these names, all that a folder has, are parts.
    """

    def is_former(folder: Path) -> bool:
        return folder.is_dir() and holds_parts(frozenset(file.name for file in folder.iterdir()))

    return frozenset(name for name in names if is_former(path.parent / name))


def move_into_place(index: Path, path: Path, former: frozenset[str]) -> tuple[Path, ...]:
    """Move the folders beside ``index`` to the place of ``path``, then the index; return all files, it first.

    Args:
        index: as it was written, in a folder of its own.
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
    path.unlink(missing_ok=True)  # from now on it would name what is not there
    for name in former:
        shutil.rmtree(path.parent / name)
    moved: list[Path] = []
    for folder in folders:
        target = path.parent / folder.name
        shutil.move(folder, target)
        moved += sorted(file for file in target.rglob("*") if file.is_file())
    with atomic_replace(path) as temporary:
        shutil.copyfile(index, temporary)
    return (path, *moved)
