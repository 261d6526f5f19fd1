"""File names of rendered images."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

IMAGE_SUFFIXES = (".png", ".exr")
"""Of names that mean images; other names mean a folder, or a film."""
UNWRITTEN_SUFFIXES = frozenset(
    {".jpg", ".jpeg", ".webp", ".gif", ".tif", ".tiff", ".bmp", ".hdr", ".avif", ".jxl"}
    | {".mov", ".m4v", ".mkv", ".avi", ".webm", ".mpg", ".mpeg", ".apng"}
)
"""Of names that mean images or films in formats that are not written, and surely no folder."""


def unique_render_names(photographs: Sequence[str]) -> tuple[str, ...]:
    """Return for each photograph's relative path the unique path of its render, without a suffix.

    ``sub/a.jpg`` becomes ``sub/a``; beside another ``sub/a.png`` both keep what tells them apart. Upper and
    lower case count as the same, as they do in the file systems of some users.
    """
    stems = [str(Path(name).with_suffix("")) for name in photographs]
    uses = Counter(stem.casefold() for stem in stems)
    names = [
        stem if uses[stem.casefold()] == 1 else photograph
        for stem, photograph in zip(stems, photographs, strict=True)
    ]
    unique = len({name.casefold() for name in names}) == len(names)
    return tuple(names if unique else photographs)


def has_number_pattern(pattern: Path) -> bool:
    """Return whether a file name has one place for a number, as ``frame_%04d.png``."""
    try:
        # with a place for a number, two numbers give two names
        return bool(pattern.name % 0 != pattern.name % 1)
    except (TypeError, ValueError):
        return False
