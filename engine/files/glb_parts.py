"""Scenes for which one GLB is too small: the names of their files, and what each says of its place."""

import re
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from octasplat.engine.files.glb_container import asset_extras

PART_KEY = "octasplat_part"
"""In the extras of a file that is one of several of a scene: its place among them, from 1, and their number.
"""
T = TypeVar("T")


def part_paths(path: Path, count: int) -> tuple[Path, ...]:
    """Return the files of a scene for which one is too small: ``path``, ``<stem>.part2.glb`` and so on."""
    return (path, *(path.with_name(f"{path.stem}.part{k}{path.suffix}") for k in range(2, count + 1)))


def in_order_of_writing(paths: Sequence[Path], contents: Sequence[T]) -> Iterator[tuple[Path, T]]:
    """Yield the files of a scene with what each is to hold, the first file last.

    A run that goes on takes the first one for all of them, as only that one is named: it is not there before
    the others are, and the one of an earlier export is not beside parts of another scene.

    Args:
        paths: of all files, by :func:`part_paths`.
        contents: of each.
    """
    if len(paths) > 1:
        paths[0].unlink(missing_ok=True)
    yield from reversed(list(zip(paths, contents, strict=True)))


def parts_left_over(path: Path, written: Collection[Path]) -> tuple[Path, ...]:
    """Return the files beside ``path`` that are called as further parts of it and were not written now."""
    number = re.compile(rf"{re.escape(path.stem)}\.part\d+{re.escape(path.suffix)}")
    there = sorted(file for file in path.parent.iterdir() if number.fullmatch(file.name))
    return tuple(file for file in there if file not in written)


def part_extras(part: int, count: int) -> dict[str, object]:
    """Return what the ``extras`` of a file say of its place among so many, from 1; nothing if it is alone."""
    return {PART_KEY: [part, count]} if count > 1 else {}


def stated_part(document: Mapping[str, Any]) -> tuple[int, int] | None:
    """Return the place of a file among those of its scene, from 1, and their number; None if it is alone."""
    match asset_extras(document).get(PART_KEY):
        case [int(part), int(count)] if 1 <= part <= count and count > 1:
            return part, count
    return None


def part_note(document: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what to tell of a file that holds only a part of its scene."""
    stated = stated_part(document)
    if stated is None:
        return ()
    return (
        f"It is part {stated[0]} of the {stated[1]} files of a scene; octasplat merge puts them together.",
    )
