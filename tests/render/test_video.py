import subprocess

import imageio_ffmpeg
import numpy as np
import pytest

from octasplat.engine.core.errors import OutputError
from octasplat.engine.render.resume import FinishedImages
from octasplat.engine.render.series import render_video
from octasplat.engine.render.video import VideoWriter

COLORS = np.array(
    [[0.8, 0.2, 0.1], [0.1, 0.7, 0.2], [0.15, 0.2, 0.9], [0.5, 0.5, 0.5], [1, 1, 1]], np.float32
)


def frame(color, width=64, height=48):
    return np.tile(color, (height, width, 1))


def read(path, width, height):
    """What ffmpeg says of a video, and its frames."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    said = done.stderr.decode().split("Output")[0]
    return said, np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3) / 255


def test_video_contains_written_frames(tmp_path):
    path = tmp_path / "new" / "colors.mp4"
    with VideoWriter(path, fps=10.0, width=64, height=48) as video:
        for color in COLORS:
            video.write(frame(color))
    said, frames = read(path, 64, 48)
    for text in ("h264", "yuv420p(tv, bt709", "64x48", "10 fps"):
        assert text in said
    assert len(frames) == len(COLORS)
    for shown, color in zip(frames, COLORS, strict=True):
        assert np.abs(shown - color).max() < 0.03
    assert [p.name for p in path.parent.iterdir()] == ["colors.mp4"]


def test_odd_sizes_gain_a_line(tmp_path):
    with VideoWriter(tmp_path / "odd.mp4", fps=30.0, width=33, height=21) as video:
        video.write(frame(COLORS[0], 33, 21))
    said, frames = read(tmp_path / "odd.mp4", 34, 22)
    assert "34x22" in said
    assert np.abs(frames[0] - COLORS[0]).max() < 0.03


def test_video_writer_error_keeps_previous_file(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"old")
    with pytest.raises(ZeroDivisionError), VideoWriter(path, fps=30.0, width=64, height=48) as video:
        video.write(frame(COLORS[0]))
        raise ZeroDivisionError
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_video_writer_unwritable_path_raises_output_error(tmp_path):
    with pytest.raises(OutputError, match="no frames"), VideoWriter(tmp_path / "a.mp4", 30.0, 64, 48):
        pass
    with (
        pytest.raises(OutputError, match=r"20 x 10 .*a\.mp4 of 64 x 48"),
        VideoWriter(tmp_path / "a.mp4", 30.0, 64, 48) as video,
    ):
        video.write(frame(COLORS[0], 20, 10))
    # An ending that names no format makes ffmpeg itself refuse.
    with (
        pytest.raises(OutputError, match=r"a\.nothing"),
        VideoWriter(tmp_path / "a.nothing", 30.0, 64, 48) as video,
    ):
        video.write(frame(COLORS[0]))
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"a\.mp4"), VideoWriter(tmp_path / "file" / "a.mp4", 30.0, 64, 48):
        pass
    with pytest.raises(OutputError, match="not open"):
        VideoWriter(tmp_path / "a.mp4", 30.0, 64, 48).write(frame(COLORS[0]))


def test_video_of_no_views_is_refused(tmp_path):
    finished = FinishedImages(tmp_path / "frames", "identity", resume=False)
    with pytest.raises(OutputError, match=r"a\.mp4 has no frames"):
        render_video((), tmp_path / "a.mp4", 30.0, lambda *_: None, finished, lambda *_: None)
    assert list(tmp_path.glob("*.mp4")) == []
