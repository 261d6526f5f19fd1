"""Relative paths in files from elsewhere: they stay below a folder, in one Unicode spelling."""

import unicodedata
from pathlib import PurePosixPath, PureWindowsPath


def check_relative_path(name: str) -> str:
    """Return a relative path that stays below its folder on every system.

    Raises:
        ValueError: it is empty or absolute, names a drive, climbs, or holds a character that no path has.

    >>> check_relative_path("left/0001.jpg")
    'left/0001.jpg'
    """
    paths = (PurePosixPath(name), PureWindowsPath(name))
    climbs = any(".." in path.parts for path in paths)
    # On Windows "C:a" and "\a" are not absolute, but lead out of the folder all the same.
    elsewhere = any(path.is_absolute() or path.drive or path.root for path in paths)
    if not name or not any(path.name for path in paths) or climbs or elsewhere or "\0" in name:
        raise ValueError(f"{name[:60]!r} is no path below the folder of the file")
    return name


def normalize_name(name: str) -> str:
    """Return a file name in Unicode form NFC, in which names from two machines are compared."""
    return unicodedata.normalize("NFC", name)
