"""Series of images, written as files of their own or as a video."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.errors import OutputError
from octasplat.engine.core.progress import ProgressCallback
from octasplat.engine.render.image_files import read_image
from octasplat.engine.render.resume import FinishedImages
from octasplat.engine.render.shots import RenderFn, Shot
from octasplat.engine.render.video import VideoWriter

VIDEO_FILE = "film.mp4"
"""Name of a film among its frames while it is written."""


OnFinished = Callable[[int], None]
"""Told how many images of a series are safe on disk, each time that one is done."""


def render_series(
    shots: Sequence[Shot],
    file_of: Callable[[int, Shot], Path],
    render_fn: RenderFn,
    finished: FinishedImages,
    progress: ProgressCallback,
    on_finished: OnFinished = lambda _count: None,
) -> tuple[Path, ...]:
    """Render each shot to a file of its own, skip finished ones, and return the files.

    Args:
        shots: what to render.
        file_of: the file of a shot, given its number and itself.
        render_fn: renders one.
        finished: what is there already.
        progress: called after each image, and within it.
        on_finished: called after each image that was rendered.

    Raises:
        OutputError: a file cannot be written.
    """
    paths = tuple(
        _render_missing(
            shots=shots,
            file_of=file_of,
            render_fn=render_fn,
            finished=finished,
            progress=progress,
            on_finished=on_finished,
        )
    )
    finished.remove_record()
    return paths


def film_files(folder: Path, count: int) -> tuple[Path, ...]:
    """Return the files of a video's frames, and of the video among them while it is written."""
    return (*(folder / f"{number:06d}.png" for number in range(count)), folder / VIDEO_FILE)


def render_video(
    shots: Sequence[Shot],
    film: Path,
    fps: float,
    render_fn: RenderFn,
    finished: FinishedImages,
    progress: ProgressCallback,
    on_finished: OnFinished = lambda _count: None,
) -> None:
    """Render shots of one image size as the frames of a video.

    The frames are stored as PNG files, as exact as the video, in the folder of ``finished`` until the video
    is complete; then they are removed, and the folder if it is empty.

    Raises:
        OutputError: there are no shots, or a file cannot be written.
    """
    if not shots:
        raise OutputError(f"The video {film} has no frames; give at least one view.")
    *frames, unfinished = film_files(finished.folder, len(shots))

    def frame(number: int, _shot: Shot) -> Path:
        return frames[number]

    first = shots[0].rays()
    try:
        with VideoWriter(unfinished, fps, first.width_px, first.height_px) as video:
            for path in _render_missing(
                shots=shots,
                file_of=frame,
                render_fn=render_fn,
                finished=finished,
                progress=progress,
                on_finished=on_finished,
            ):
                # read back, so that resumed frames and new ones are the same
                video.write(_display_values(path))
        film.parent.mkdir(parents=True, exist_ok=True)
        unfinished.replace(film)
        for path in frames:
            path.unlink(missing_ok=True)
        finished.remove_record()
    except OSError as error:
        raise OutputError(f"Cannot write the video {film}: {error.strerror or error}.") from error
    finally:
        with suppress(OSError):  # where nothing was done yet, or all is, nothing stays
            finished.folder.rmdir()


def _render_missing(
    shots: Sequence[Shot],
    file_of: Callable[[int, Shot], Path],
    render_fn: RenderFn,
    finished: FinishedImages,
    progress: ProgressCallback,
    on_finished: OnFinished,
) -> Iterator[Path]:
    total = len(shots)
    for number, shot in enumerate(shots):
        path = file_of(number, shot)
        # Nothing is told of the others, lest they count for the time that is left.
        if not finished.is_finished(path):

            def part(share: float, done: int = number) -> None:
                if share < 1:
                    progress(done, total, share)

            progress(number, total)
            render_fn(shot, path, part)
            finished.add(path)
            on_finished(number + 1)
            progress(number + 1, total)
        yield path
    progress(total, total)


def _display_values(path: Path) -> Float32[np.ndarray, "h w 3"]:
    return read_image(path)[..., :3]
