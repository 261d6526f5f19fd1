"""Files given by name or by pattern."""

import glob
import re
from collections.abc import Sequence
from pathlib import Path

from octasplat.engine.core.errors import ConfigError


def expand_patterns(given: Sequence[Path]) -> tuple[Path, ...]:
    """Return the files that are given by names or by patterns such as ``frames/*.ply``.

    The matches of a pattern are in the order of the numbers in their names.

    Raises:
        ConfigError: a pattern matches nothing.
    """
    paths: list[Path] = []
    for path in given:
        if path.exists() or not glob.has_magic(str(path)):  # an existing name wins, though it has brackets
            paths.append(path)
            continue
        matches = sorted(glob.glob(str(path), recursive=True), key=_natural_sort_key)  # noqa: PTH207 (may be absolute)
        if not matches:
            raise ConfigError(f"{path}: no file matches this pattern.")
        paths.extend(map(Path, matches))
    return tuple(paths)


def _natural_sort_key(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key in which 10 comes after 9."""
    return [
        # numbers sort before texts, so that parts of both kinds compare
        (0, int(part), "") if part.isdecimal() else (1, 0, part)
        for part in re.split(r"(\d+)", name)
        if part
    ]
