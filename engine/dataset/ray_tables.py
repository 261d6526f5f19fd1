"""Tables of ray directions for cameras whose rays are too expensive to compute each time.

``directions.bin`` holds, for every camera that is not a pinhole, the unit direction through the centre of
every pixel (row by row, 3 float32, camera coordinates; not-a-number where the model has none);
``directions.json`` says for which cameras.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64

from octasplat.engine.core import versions
from octasplat.engine.core.errors import OutputError
from octasplat.engine.core.writing import atomic_replace, write_text
from octasplat.engine.dataset.camera import ROUND_TRIP_TOLERANCE_PX, Camera
from octasplat.engine.dataset.mapped_array import MappedArray

MAX_TABLE_BYTES = 4 << 30
"""Cameras whose tables do not fit in here are un-projected at every call."""

_PIXELS_PER_BLOCK = 1 << 18


@dataclass(frozen=True, eq=False)
class RayTables:
    """Direction tables of the cameras of a scene.

    Attributes:
        values: the tables one after the other, flat.
        offsets: first pixel of each camera's table, :data:`NO_TABLE_PINHOLE` or :data:`NO_TABLE_COMPUTED`.
    """

    values: MappedArray
    offsets: Int64[np.ndarray, " cameras"]


NO_TABLE_PINHOLE = -1
"""Stands for the table of a camera whose rays follow from four numbers."""

NO_TABLE_COMPUTED = -2
"""Stands for the table of a camera that is un-projected at every call."""


def open_ray_tables(cameras: Sequence[Camera], folder: Path, max_bytes: int = MAX_TABLE_BYTES) -> RayTables:
    """Map the tables of ``cameras``, computing them into ``folder`` first unless they are there already.

    Args:
        cameras: cameras of the scene, without duplicates; earlier ones get tables first.
        folder: folder of the table files.
        max_bytes: limit on all tables together.

    Raises:
        OutputError: the tables cannot be written.
    """
    offsets = np.full(len(cameras), NO_TABLE_PINHOLE, dtype=np.int64)
    tabled: list[Camera] = []
    pixels = 0
    for index, camera in enumerate(cameras):
        if camera.is_pinhole:
            continue
        size = camera.width_px * camera.height_px
        if (pixels + size) * 12 > max_bytes:  # 3 float32 a pixel
            offsets[index] = NO_TABLE_COMPUTED
            continue
        offsets[index] = pixels
        tabled.append(camera)
        pixels += size
    if not tabled:
        return RayTables(MappedArray.empty(np.float32), offsets)
    table, index_file = folder / "directions.bin", folder / "directions.json"
    if not _is_up_to_date(table, index_file, _index_text(tabled), 12 * pixels):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            # First of all: an index must never describe a table of other cameras.
            index_file.unlink(missing_ok=True)
            with atomic_replace(table) as temporary, temporary.open("wb") as handle:
                for camera in tabled:
                    for start in range(0, camera.height_px, rows_per_block(camera.width_px)):
                        stop = min(start + rows_per_block(camera.width_px), camera.height_px)
                        centres = pixel_centres(camera.width_px, start, stop)
                        handle.write(camera.directions_cam(centres).astype(np.float32).tobytes())
            write_text(index_file, _index_text(tabled))
        except OSError as error:
            raise OutputError(
                f"The ray tables of {12 * pixels / 1e9:.2f} GB cannot be written to {folder} "
                f"({error.strerror}); free space there or name another folder."
            ) from error
    return RayTables(MappedArray.open(table, np.float32), offsets)


def rows_per_block(width_px: int) -> int:
    """Return how many rows to process at a time so that scratch memory stays at a few megabytes."""
    return max(1, _PIXELS_PER_BLOCK // width_px)


def pixel_centres(width_px: int, first_row: int, end_row: int) -> Float64[np.ndarray, "n 2"]:
    """Return the image points (x, y) of all pixel centres of some rows, row by row, in pixels.

    >>> pixel_centres(2, 0, 2).tolist()
    [[0.5, 0.5], [1.5, 0.5], [0.5, 1.5], [1.5, 1.5]]
    """
    y, x = np.mgrid[first_row:end_row, 0:width_px]
    return np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)


def has_rays_everywhere(camera: Camera) -> bool:
    """Return whether ``camera`` has a ray for each point of a grid over its image, corners included."""
    x = np.linspace(0.5, camera.width_px - 0.5, 16)
    y = np.linspace(0.5, camera.height_px - 0.5, 16)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return bool(np.isfinite(camera.directions_cam(grid)).all())


def _index_text(cameras: Sequence[Camera]) -> str:
    listed = [[camera.model, list(camera.params), camera.width_px, camera.height_px] for camera in cameras]
    of_version = {"tolerance_px": ROUND_TRIP_TOLERANCE_PX, versions.STATED: versions.RESULTS_VERSION}
    return json.dumps({**of_version, "cameras": listed}) + "\n"


def _is_up_to_date(table: Path, index_file: Path, index_text: str, size: int) -> bool:
    try:
        return index_file.read_text(encoding="utf-8") == index_text and table.stat().st_size == size
    except (OSError, ValueError):
        return False


def iterate_row_blocks(
    view_index: int, width: int, height: int
) -> Iterator[tuple[slice, Int64[np.ndarray, " n"], Int64[np.ndarray, " n"], Int64[np.ndarray, " n"]]]:
    """Yield all pixels of a view, some rows at a time: their index in the view, view, y and x."""
    step = rows_per_block(width)
    for start in range(0, height, step):
        stop = min(start + step, height)
        y, x = np.divmod(np.arange(start * width, stop * width, dtype=np.int64), width)
        yield slice(start * width, stop * width), np.full(len(y), view_index, dtype=np.int64), y, x
