"""Photographs are read to their ends before poses are searched, which takes far longer."""

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.events import EventListener, Warned
from octasplat.engine.dataset.damaged_images import find_damaged, refuse_damaged
from octasplat.engine.dataset.image_info import ImageInfo
from octasplat.engine.dataset.images import read_image_info

MIN_RECOMMENDED_SIDE_PX = 480
"""Below this, what COLMAP finds was seen to be wrong without any sign of it."""


def check_photographs_decode(
    folder: Path,
    names: Sequence[str],
    *,
    threads: int = 0,
    on_count: Callable[[int], None] = lambda _done: None,
) -> None:
    """Refuse photographs whose files begin well and end early: COLMAP takes them, the training cannot.

    Files that are no images from their beginning are left out by COLMAP, and told.

    Args:
        folder: of the photographs.
        names: of them in it.
        threads: to use; 0 means all cores.
        on_count: hears of photographs.

    Raises:
        DatasetError: files are damaged or cut short; all of them are named, so that they can be replaced or
            taken away in one go.
    """
    readable = read_image_infos(folder, names)
    faults = find_damaged(
        [(folder / name, info) for name, info in readable.items()], threads=threads, on_count=on_count
    )
    refuse_damaged(faults, folder, may_leave=True)


def read_image_infos(images: Path, names: Sequence[str]) -> dict[str, ImageInfo]:
    """Return what the headers of photographs say, for those that can be read."""
    found: dict[str, ImageInfo] = {}
    for name in names:
        with contextlib.suppress(DatasetError):
            found[name] = read_image_info(images / name)
    return found


def warn_of_small_photographs(infos: Sequence[ImageInfo], progress: EventListener) -> None:
    """Warn where all photographs are so small that poses found from them may be wrong."""
    longest = max(max(info.width_px, info.height_px) for info in infos)
    if longest < MIN_RECOMMENDED_SIDE_PX:
        progress(
            Warned(
                f"The photographs are {longest} px long at most; poses found from such small ones may be "
                "wrong, so give them at full size."
            )
        )
