"""Files below a folder, whether links lead to them or not."""

import os
from collections.abc import Iterator
from pathlib import Path


def files_below(folder: Path, above: frozenset[str] = frozenset()) -> Iterator[Path]:
    """Yield the files below a folder, in no order; those of folders that cannot be read are left out.

    Args:
        folder: which.
        above: where the folders that it was reached through lie; a link to one of them is not followed.
    """
    place = os.path.realpath(folder)
    if place in above:
        return
    try:
        found = list(folder.iterdir())
    except PermissionError:
        return
    for path in found:
        if path.is_dir():
            yield from files_below(path, above | {place})
        elif path.is_file():
            yield path
