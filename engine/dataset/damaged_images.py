"""Images that cannot be read to their ends: all of a dataset are named at once, to be replaced in one go."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

from octasplat.engine.core.errors import DamagedImageError, DatasetError
from octasplat.engine.core.name_lists import name_list
from octasplat.engine.dataset.image_info import ImageInfo
from octasplat.engine.dataset.images import read_image_info, read_photo

MAX_NAMED = 20
"""Most damaged images that a sentence names."""
DECODING_BYTES = 3 << 29
"""Memory that decoding threads may take together; one thread always runs."""
_BYTES_PER_PIXEL, _DEEP_BYTES_PER_PIXEL, _ALPHA_BYTES_PER_PIXEL = 10, 36, 60
"""Of 8 bits; of more, as stored, as float32, and a copy of either while channels are rearranged; and with
alpha, by which colors are multiplied and divided: 5, 24 and 57 were measured of photographs made smaller."""

ResultT = TypeVar("ResultT")


def decoding_workers(threads: int, infos: Iterable[ImageInfo]) -> int:
    """Return how many threads decode images of these sizes at a time.

    Args:
        threads: that may be used; 0 takes one per processor.
        infos: headers of the images.
    """
    largest = max((_decoding_bytes(info) for info in infos), default=1)
    return min(threads if threads > 0 else os.cpu_count() or 1, max(1, DECODING_BYTES // largest))


def _decoding_bytes(info: ImageInfo) -> int:
    each = _BYTES_PER_PIXEL if info.storage == "8-bit" else _DEEP_BYTES_PER_PIXEL
    return (_ALPHA_BYTES_PER_PIXEL if info.has_alpha else each) * info.width_px * info.height_px


def read_headers(
    paths: Iterable[Path], known: Mapping[Path, ImageInfo] | None = None
) -> tuple[dict[Path, ImageInfo], list[DamagedImageError]]:
    """Return the headers of images by their files, and the faults of those that are no images.

    Args:
        paths: the files.
        known: headers that were read before.

    Raises:
        DatasetError: an image is refused for another reason.
    """
    found: dict[Path, ImageInfo] = {}
    faults: list[DamagedImageError] = []
    for path in paths:
        try:
            found[path] = (known or {}).get(path) or read_image_info(path)
        except DamagedImageError as error:
            faults.append(error)
    return found, faults


def collect_results(
    futures: Sequence["Future[ResultT]"], on_count: Callable[[int], None] = lambda _done: None
) -> tuple[list[ResultT], list[DamagedImageError]]:
    """Return the results of reading images in order, and the faults of those that are damaged.

    Raises:
        DatasetError: an image is refused for another reason.
    """
    results: list[ResultT] = []
    faults: list[DamagedImageError] = []
    for done, future in enumerate(futures, start=1):
        try:
            results.append(future.result())
        except DamagedImageError as error:
            faults.append(error)
        on_count(done)
    return results, faults


def find_damaged(
    photographs: Sequence[tuple[Path, ImageInfo]],
    *,
    threads: int = 0,
    on_count: Callable[[int], None] = lambda _done: None,
) -> list[DamagedImageError]:
    """Return the faults of photographs whose headers are fine and whose files end early.

    Args:
        photographs: files and their headers.
        threads: to use; 0 takes one per processor.
        on_count: called with the number of photographs that are read.
    """

    def read(path: Path, info: ImageInfo) -> None:
        read_photo(path, info.width_px, info.height_px, 8)

    with ThreadPoolExecutor(decoding_workers(threads, (info for _, info in photographs))) as pool:
        futures = [pool.submit(read, path, info) for path, info in photographs]
        try:
            return collect_results(futures, on_count)[1]
        finally:
            # Where somebody asks to stop, the other photographs need not be read.
            pool.shutdown(cancel_futures=True)


def refuse_damaged(faults: Sequence[DamagedImageError], folder: Path, *, may_leave: bool = False) -> None:
    """Refuse images that cannot be read to their ends.

    Args:
        faults: those that were found; none passes.
        folder: in which the images lie.
        may_leave: whether the dataset could do without them.

    Raises:
        DatasetError: there are some; of a single one the reason is told, of several the names.
    """
    if not faults:
        return
    way_out = ", or take {} out of the folder" if may_leave else ""
    if len(faults) == 1:
        raise DatasetError(f"{str(faults[0]).removesuffix('.')}{way_out.format('it')}.") from faults[0]
    names = [
        fault.path.relative_to(folder).as_posix() if fault.path.is_relative_to(folder) else str(fault.path)
        for fault in faults
    ]
    more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    raise DatasetError(
        f"{len(names)} images in {folder} are damaged, cut short or none at all "
        f"({name_list(names[:MAX_NAMED], MAX_NAMED)}{more}); replace the files{way_out.format('them')}."
    )
