"""Working folder of a pose search: photographs under other names, and progress of its stages."""

import shutil
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

from octasplat.engine.core.events import EventListener, ignore_events
from octasplat.engine.core.progress import counted_phase
from octasplat.engine.dataset.images import read_image_info, read_photo
from octasplat.engine.poses.config import READING

_COLMAP_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})


def link_photographs(
    images: Path, names: Sequence[str], folder: Path, progress: EventListener = ignore_events
) -> tuple[str, ...]:
    """Make a folder of photographs whose names COLMAP can list and number; returns these names.

    COLMAP lists pairs by names with a space between, and its numbers follow the order of names. Those in
    formats that COLMAP does not read are copied as PNG, which is a stage of its own; the others are links.
    """
    suffixes = [Path(name).suffix.lower() for name in names]
    aliases = tuple(
        f"{k:06d}{suffix if suffix in _COLMAP_SUFFIXES else '.png'}" for k, suffix in enumerate(suffixes)
    )
    shutil.rmtree(folder, ignore_errors=True)  # of a search that was stopped
    folder.mkdir()
    copied = []
    for alias, name, suffix in zip(aliases, names, suffixes, strict=True):
        if suffix in _COLMAP_SUFFIXES:
            (folder / alias).symlink_to((images / name).resolve())
        else:
            copied.append((images / name, folder / alias))
    if copied:  # a second or more for each large photograph
        with progress_stage(READING, len(copied), progress) as at:
            for done, (photograph, target) in enumerate(copied, start=1):
                _write_png(photograph, target)
                at(done)
    return aliases


def _write_png(photograph: Path, target: Path) -> None:
    """Write the display colors of a photograph as a PNG of 8 bits, with its EXIF: focal length and GPS."""
    info = read_image_info(photograph)
    colors, _ = read_photo(photograph, info.width_px, info.height_px, 8)
    exif = _stored_exif(photograph)
    Image.fromarray(colors).save(target, compress_level=1, exif=exif)  # fast: the file is temporary


def _stored_exif(photograph: Path) -> bytes:
    """Return the EXIF of a photograph as it is stored; empty where it has none, or has no place for it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # many pixels, none of which are decoded
            with Image.open(photograph) as image:
                return bytes(image.info.get("exif", b""))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return b""


@contextmanager
def progress_stage(name: str, steps: int, progress: EventListener) -> Iterator[Callable[[int], None]]:
    """Run a stage with a known number of steps; yields the callback that takes the count of done steps."""
    with counted_phase(name, progress, steps) as count:
        yield lambda done: count(done, steps)
