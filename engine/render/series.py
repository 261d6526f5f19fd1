"""Series of images, to files of their own or to a film: one way for scenes alone and for those on a stage."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from octasplat.engine.errors import OutputError
from octasplat.engine.render.images import read_image
from octasplat.engine.render.jobs import Paint, Shot
from octasplat.engine.render.kept import KeptImages
from octasplat.engine.render.video import VideoWriter
from octasplat.engine.stages import Count

FILM = "film.mp4"
"""Name of a film among its frames while it is written."""


Kept = Callable[[int], None]
"""Told how many images of a series are safe on disk, each time that one is done."""


def render_series(
    shots: Sequence[Shot],
    file_of: Callable[[int, Shot], Path],
    paint: Paint,
    kept: KeptImages,
    progress: Count,
    on_kept: Kept = lambda _count: None,
) -> tuple[Path, ...]:
    """Render each shot to a file of its own, but for those that are there already; returns the files.

    Args:
        shots: what to render.
        file_of: the file of a shot, given its number and itself.
        paint: renders one.
        kept: what is there already.
        progress: told after each image, and within it.
        on_kept: told after each image that was rendered.

    Raises:
        OutputError: a file cannot be written.
    """
    paths = tuple(_rendered(shots, file_of, paint, kept, progress, on_kept))
    kept.finish()
    return paths


def film_files(folder: Path, count: int) -> tuple[Path, ...]:
    """Return the files of a film's frames, and of the film among them while it is written."""
    return (*(folder / f"{number:06d}.png" for number in range(count)), folder / FILM)


def render_film(
    shots: Sequence[Shot],
    film: Path,
    fps: float,
    paint: Paint,
    kept: KeptImages,
    progress: Count,
    on_kept: Kept = lambda _count: None,
) -> None:
    """Render shots of one image size as the frames of a film.

    The frames are kept as PNG files, which lose nothing that the film has, in the folder of ``kept``, until
    the film is whole; then they go, and the folder unless it holds something else.

    Raises:
        OutputError: a file cannot be written.
    """
    *frames, unfinished = film_files(kept.folder, len(shots))

    def frame(number: int, _shot: Shot) -> Path:
        return frames[number]

    first = shots[0].rays()
    try:
        with VideoWriter(unfinished, fps, first.width_px, first.height_px) as video:
            for path in _rendered(shots, frame, paint, kept, progress, on_kept):
                video.write(_display_values(path))
        film.parent.mkdir(parents=True, exist_ok=True)
        unfinished.replace(film)
        for path in frames:
            path.unlink(missing_ok=True)
        kept.finish()
    except OSError as error:
        raise OutputError(f"Cannot write the video {film}: {error.strerror or error}.") from error
    finally:
        with suppress(OSError):  # where nothing was done yet, or all is, nothing stays
            kept.folder.rmdir()


def _rendered(
    shots: Sequence[Shot],
    file_of: Callable[[int, Shot], Path],
    paint: Paint,
    kept: KeptImages,
    progress: Count,
    on_kept: Kept,
) -> Iterator[Path]:
    whole = len(shots)
    for number, shot in enumerate(shots):
        path = file_of(number, shot)
        if not kept.has(path):  # nothing is told of the others, lest they count for the time that is left

            def part(share: float, done: int = number) -> None:
                if share < 1:
                    progress(done, whole, share)

            progress(number, whole)
            paint(shot, path, part)
            kept.add(path)
            on_kept(number + 1)
            progress(number + 1, whole)
        yield path
    progress(whole, whole)


def _display_values(path: Path) -> Float32[np.ndarray, "h w 3"]:
    return read_image(path)[..., :3]
