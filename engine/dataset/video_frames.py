"""Photographs from a video: the sharpest frame of each stretch, read by ffmpeg."""

import json
import math
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from octasplat.engine.core.errors import DatasetError, OutputError
from octasplat.engine.core.partial_folders import partial_folder
from octasplat.engine.core.scene_layout import VIDEO_SUFFIXES
from octasplat.engine.core.writing import write_json
from octasplat.engine.dataset.image_sizes import ImageSizes

RECORD_FILE = "frames.json"
"""Says of which video the frames are; beside the folder of the frames."""
_JPEG_QUALITY = 95
_CANDIDATES, _MAX_RATE = 12, 30.0
"""Frames of a stretch that are looked at, and most in a second."""
_SHARPNESS_SIDE_PX = 720
"""Frames are compared at about this size: noise of single pixels counts less there."""

OnStep = Callable[[int, int], None]
"""Told how many frames of how many were read."""


def is_video(path: Path) -> bool:
    """Return whether a path is that of a video file, by its name."""
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


def write_frames(video: Path, folder: Path, frames_per_second: float, on_step: OnStep) -> int:
    """Write the sharpest frame of each stretch of a video as a photograph; frames of the same video stay.

    Args:
        video: the file.
        folder: of the dataset; the frames go to ``images/`` in it.
        frames_per_second: stretches in a second.
        on_step: hears of frames that were read.

    Returns:
        The number of photographs.

    Raises:
        DatasetError: the video cannot be read.
        OutputError: the folder holds something else, or cannot be written.
    """
    images = folder / "images"
    facts = video.stat()
    record = {
        "video": str(video.resolve()),
        "size_bytes": facts.st_size,
        "modified": facts.st_mtime,
        "frames_per_second": frames_per_second,
    }
    if folder.exists():
        if _read_record(folder) == record:
            return sum(1 for _ in images.iterdir())
        raise OutputError(
            f"{folder} holds something else than frames of {video.name} at that rate; remove or rename it."
        )
    try:
        with partial_folder(folder) as partial:
            (partial / "images").mkdir()
            count = _write_sharpest(video, partial / "images", frames_per_second, on_step)
            write_json(partial / RECORD_FILE, record)
            try:
                partial.rename(folder)
            except OSError:
                if _read_record(folder) != record:  # another process was not first with the same frames
                    raise
    except OSError as error:
        raise OutputError(f"{folder} cannot be written ({error.strerror or error}).") from None
    return count


def planned_frames(video: Path, frames_per_second: float) -> ImageSizes:
    """Return the size and number of the photographs that :func:`write_frames` would write.

    Raises:
        DatasetError: the video cannot be read.
    """
    # Rounding must not add a stretch to a duration of whole ones.
    count = max(1, math.ceil(_duration_seconds(video) * frames_per_second - 1e-6))
    with _open_frames(video, frames_per_second, most=1) as frames:
        shapes = [frame.shape for frame in frames]
    if not shapes:
        raise _unreadable(video, "it has no pictures")
    return ImageSizes(shapes[0][1], shapes[0][0], count)


@contextmanager
def _open_frames(
    video: Path, rate: float, most: int | None = None
) -> Iterator[Iterator[UInt8[np.ndarray, "height width 3"]]]:
    """Yield the frames of a video at an even rate, turned as they are shown, one by one; the first ``most``.

    Raises:
        DatasetError: ffmpeg cannot read the file.
    """
    import imageio_ffmpeg

    command = [
        imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-loglevel", "error", "-i", str(video), "-an", "-sn",
        "-vf", f"fps={rate:g}", *(() if most is None else ("-frames:v", str(most))),
        "-f", "image2pipe", "-c:v", "ppm", "-",
    ]  # fmt: skip
    with (
        # Messages go into a file: a full pipe of them would block ffmpeg while its frames are read.
        tempfile.TemporaryFile() as said,
        subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=said) as process,  # noqa: S603
    ):
        assert process.stdout is not None
        try:
            yield _read_ppm_images(process.stdout)
            if process.wait() != 0:
                said.seek(0)
                raise _unreadable(video, said.read().decode(errors="replace"))
        finally:
            process.kill()  # the reader may have stopped early, while ffmpeg waits to write


def _read_ppm_images(stream: IO[bytes]) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    """Yield the images of a stream of binary PPM files."""
    while stream.readline():  # P6
        width, height = map(int, stream.readline().split())
        stream.readline()  # the largest value
        content = stream.read(3 * width * height)
        if len(content) < 3 * width * height:
            return  # ffmpeg ended, and says why
        yield np.frombuffer(content, np.uint8).reshape(height, width, 3)


def _duration_seconds(video: Path) -> float:
    """Return how long a video is.

    Raises:
        DatasetError: there is no ffmpeg, or it cannot read the file.
    """
    import imageio_ffmpeg

    try:
        return float(imageio_ffmpeg.count_frames_and_secs(str(video))[1])
    except (OSError, RuntimeError) as error:
        raise _unreadable(video, str(error)) from None


def _unreadable(video: Path, said: str) -> DatasetError:
    reason = next((line.strip() for line in reversed(said.splitlines()) if line.strip()), "ffmpeg refuses it")
    return DatasetError(
        f"{video.name} cannot be read as a video ({reason[:200].rstrip('.')}); convert it to MP4, or save "
        "frames of it as photographs with another program."
    )


def sharpness(image: UInt8[np.ndarray, "height width 3"]) -> float:
    """Return how sharp a picture is: the variance of its second differences, which blur makes small."""
    step = max(1, round(max(image.shape[:2]) / _SHARPNESS_SIDE_PX))
    rows, columns = (size - size % step for size in image.shape[:2])
    grey = image[:rows, :columns].astype(np.float32).mean(axis=2)
    small = grey.reshape(rows // step, step, columns // step, step).mean(axis=(1, 3))
    curvature = (
        4 * small[1:-1, 1:-1] - small[:-2, 1:-1] - small[2:, 1:-1] - small[1:-1, :-2] - small[1:-1, 2:]
    )
    return float(curvature.var()) if curvature.size else 0.0


def _write_sharpest(video: Path, images: Path, frames_per_second: float, on_step: OnStep) -> int:
    """Write the sharpest frame of each stretch; returns how many there are."""
    looked_at = max(frames_per_second, min(_MAX_RATE, _CANDIDATES * frames_per_second))
    total = max(1, round(_duration_seconds(video) * looked_at))
    count, stretch, best_sharpness = 0, 0, -1.0
    best: UInt8[np.ndarray, "height width 3"] | None = None
    with _open_frames(video, looked_at) as frames:
        for number, image in enumerate(frames):
            # A quotient may be rounded to just below a whole number.
            at = int(number / looked_at * frames_per_second + 1e-9)
            if at != stretch and best is not None:
                _write_jpeg(best, images / f"{count:05d}.jpg")
                count, stretch, best_sharpness = count + 1, at, -1.0
            if (found := sharpness(image)) > best_sharpness:
                best, best_sharpness = image, found
            on_step(min(number + 1, total), total)
    if best is not None:
        _write_jpeg(best, images / f"{count:05d}.jpg")
        count += 1
    return count


def _write_jpeg(image: UInt8[np.ndarray, "height width 3"], path: Path) -> None:
    Image.fromarray(image).save(path, quality=_JPEG_QUALITY, subsampling=0)


def _read_record(folder: Path) -> object:
    try:
        return json.loads((folder / RECORD_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
