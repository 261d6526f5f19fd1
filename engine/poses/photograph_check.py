"""Photographs are read to their ends before poses are searched, which takes far longer."""

import contextlib
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from octasplat.engine.core.errors import DatasetError
from octasplat.engine.core.events import EventListener, Warned
from octasplat.engine.dataset.image_info import ImageInfo
from octasplat.engine.dataset.images import read_image_info, read_photo

MIN_RECOMMENDED_SIDE_PX = 480
"""Below this, what COLMAP finds was seen to be wrong without any sign of it."""
MAX_NAMED = 20
"""Most damaged photographs that are named."""
DECODING_BYTES = 2 << 30
"""Memory that decoding threads may take together; one thread always runs."""


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
    sizes = []
    for name in names:
        try:
            info = read_image_info(folder / name)
        except DatasetError:
            continue
        sizes.append((folder / name, info.width_px, info.height_px))
    # Bytes a pixel: as stored, as float32, and a copy of either while channels are rearranged.
    largest = max((36 * width * height for _, width, height in sizes), default=1)
    workers = min(threads if threads > 0 else os.cpu_count() or 1, max(1, DECODING_BYTES // largest))

    def read(file: tuple[Path, int, int]) -> None:
        path, width, height = file
        read_photo(path, width, height, 8)

    with ThreadPoolExecutor(workers) as pool:
        futures = [pool.submit(read, file) for file in sizes]
        try:
            faults = []
            for done, future in enumerate(futures, start=1):
                try:
                    future.result()
                except DatasetError as error:
                    faults.append((sizes[done - 1][0], error))
                on_count(done)
        finally:
            pool.shutdown(cancel_futures=True)
    if len(faults) == 1:
        # The reason of a single one is told, too.
        raise DatasetError(f"{str(faults[0][1]).removesuffix('.')}, or take it out of the folder.")
    if faults:
        damaged = [path.relative_to(folder).as_posix() for path, _ in faults]
        more = f" and {len(damaged) - MAX_NAMED} more" if len(damaged) > MAX_NAMED else ""
        raise DatasetError(
            f"{len(damaged)} photographs of {folder} are damaged or cut short "
            f"({', '.join(damaged[:MAX_NAMED])}{more}); replace the files, or take them out of the folder."
        )


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
