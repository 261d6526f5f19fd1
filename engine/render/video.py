"""Videos from frames, by the ffmpeg program in the imageio-ffmpeg package.

ffmpeg runs as a program of its own; frames go to it through a pipe as they are made.
"""

import subprocess
import tempfile
from contextlib import ExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import IO

import imageio_ffmpeg
import numpy as np
from jaxtyping import Float32

from octasplat.engine.core.color import to_bytes
from octasplat.engine.core.errors import OutputError
from octasplat.engine.core.writing import atomic_replace

DEFAULT_CRF = 18


class VideoWriter:
    """Writer of display values as an H.264 video that common players show (yuv420p, BT.709).

    Use it as a context manager. The file appears under its name only when the block ends without an error.
    Odd widths and heights, which the format does not allow, gain a copy of the last column or row.

    Example::

        with VideoWriter(Path("turn.mp4"), fps=30, width=640, height=360) as video:
            for frame in frames:
                video.write(frame)
    """

    def __init__(self, path: Path, fps: float, width: int, height: int, *, crf: int = DEFAULT_CRF) -> None:
        """Prepare a video; nothing is written before the block begins.

        Args:
            path: Where to; ``.mp4``.
            fps: Frames per second.
            width: Of every frame, in pixels.
            height: Of every frame, in pixels.
            crf: Constant rate factor of x264: 0 is lossless, 18 looks so, 51 is worst.
        """
        self._path, self._fps, self._width, self._height, self._crf = path, fps, width, height, crf
        self._stack = ExitStack()
        self._process: subprocess.Popen[bytes] | None = None
        self._messages: IO[bytes] | None = None
        self._frames = 0

    def __enter__(self) -> "VideoWriter":
        """Start ffmpeg.

        Raises:
            OutputError: The folder cannot be made, or there is no ffmpeg for this machine.
        """
        try:
            with ExitStack() as stack:
                temporary = stack.enter_context(atomic_replace(self._path))
                # A file rather than a pipe, which would have to be emptied lest ffmpeg wait.
                self._messages = stack.enter_context(tempfile.TemporaryFile())
                self._process = subprocess.Popen(  # noqa: S603
                    self._ffmpeg_command(temporary),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=self._messages,
                )
                self._stack = stack.pop_all()
        except (OSError, RuntimeError) as error:
            raise OutputError(f"Cannot write the video {self._path}: {error}.") from error
        return self

    def write(self, rgb_srgb: Float32[np.ndarray, "h w 3"]) -> None:
        """Append a frame.

        Raises:
            OutputError: The frame is not of the video's size, or ffmpeg stopped.
        """
        if self._process is None or self._process.stdin is None:
            raise OutputError(f"The video {self._path} is not open; write its frames inside the with block.")
        height, width = rgb_srgb.shape[:2]
        if (width, height) != (self._width, self._height):
            raise OutputError(
                f"A frame of {width} x {height} pixels does not fit the video {self._path} of "
                f"{self._width} x {self._height}."
            )
        frame = np.pad(to_bytes(rgb_srgb), [(0, height % 2), (0, width % 2), (0, 0)], mode="edge")
        try:
            self._process.stdin.write(np.ascontiguousarray(frame).data)
        except OSError as error:
            raise OutputError(f"Cannot write the video {self._path}: {self._ffmpeg_error()}.") from error
        self._frames += 1

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Finish the video, or remove the incomplete file if the block failed.

        Raises:
            OutputError: ffmpeg failed, or there were no frames.
        """
        process, self._process = self._process, None
        if process is None:
            return
        if error is not None:
            process.kill()
            self._close(process)
            self._stack.__exit__(kind, error, traceback)
            return
        try:
            # Whatever is raised inside makes the stack remove the unfinished file.
            with self._stack:
                status = self._close(process)
                if self._frames == 0:
                    raise OutputError(f"The video {self._path} got no frames.")
                if status != 0:
                    raise OutputError(f"Cannot write the video {self._path}: {self._ffmpeg_error()}.")
        except OSError as failure:
            raise OutputError(f"Cannot write the video {self._path}: {failure}.") from failure

    @staticmethod
    def _close(process: "subprocess.Popen[bytes]") -> int:
        """End the stream of frames and wait for the exit status."""
        # ffmpeg may be gone already; its exit status tells.
        with suppress(OSError):
            if process.stdin is not None:
                process.stdin.close()
        return process.wait()

    def _ffmpeg_command(self, target: Path) -> list[str]:
        """Return ffmpeg's arguments: raw RGB in, H.264 out, with the color space stated in the file."""
        size = f"{self._width + self._width % 2}x{self._height + self._height % 2}"
        return [
            imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error",
            "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", f"{self._fps:g}", "-i", "-",
            # full-range sRGB to BT.709 video levels
            "-vf", "scale=out_color_matrix=bt709:out_range=tv", "-an",
            "-c:v", "libx264", "-crf", str(self._crf), "-preset", "medium", "-pix_fmt", "yuv420p",
            "-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "iec61966-2-1",
            "-color_range", "tv", "-movflags", "+faststart", str(target),
        ]  # fmt: skip

    def _ffmpeg_error(self) -> str:
        """Return the last line of ffmpeg's error output."""
        if self._messages is None:
            return "ffmpeg stopped"
        self._messages.seek(0)
        lines = self._messages.read().decode("utf-8", "replace").strip().splitlines()
        return lines[-1].rstrip(".") if lines else "ffmpeg stopped without a message"
