"""Files below a folder, whether links lead to them or not."""

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from octasplat.engine.core.name_lists import name_list
from octasplat.engine.core.scene_layout import is_ignored_file


def files_below(
    folder: Path,
    above: frozenset[str] = frozenset(),
    on_unreadable: Callable[[Path], None] = lambda _folder: None,
) -> Iterator[Path]:
    """Yield the files below a folder, in no order; those of folders that cannot be read are left out.

    Args:
        folder: which.
        above: where the folders that it was reached through lie; a link to one of them is not followed.
        on_unreadable: called with each folder that cannot be read.
    """
    place = os.path.realpath(folder)
    if place in above:
        return
    try:
        found = list(folder.iterdir())
    except PermissionError:
        on_unreadable(folder)
        return
    for path in found:
        if path.is_dir():
            yield from files_below(path, above | {place}, on_unreadable)
        elif path.is_file():
            yield path


def unreadable_folders_sentence(folders: Sequence[Path], root: Path) -> str | None:
    """Return what to tell of folders below ``root`` that cannot be read; None for hidden ones or none."""
    names = sorted(folder.relative_to(root).as_posix() for folder in folders)
    visible = [name for name in names if name == "." or not is_ignored_file(name)]
    return f"Files in folders that cannot be read are left out ({name_list(visible)})." if visible else None
