"""Photographs from videos: the sharpest frame of each stretch."""

import json
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from octasplat.engine.core.errors import DatasetError, OutputError
from octasplat.engine.core.events import Noted
from octasplat.engine.dataset.video_frames import is_video, planned_frames, sharpness, write_frames
from octasplat.engine.operations.reconstruct import ReconstructRequest, run, scene_folder

FPS, SECONDS = 10, 3
SHARP = (3, 17, 22)
"""The frame of each second that is sharp; its brightness says which it is."""


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three seconds of a flat picture with one frame of a checkerboard in each."""
    path = tmp_path_factory.mktemp("film") / "clip.mp4"
    writer = imageio_ffmpeg.write_frames(path, (96, 64), fps=FPS, quality=9, macro_block_size=1)
    writer.send(None)
    y, x = np.mgrid[:64, :96] // 8
    for number in range(FPS * SECONDS):
        frame = np.full((64, 96, 3), 60 + 4 * number, np.uint8)
        if number in SHARP:
            frame[(x + y) % 2 == 0] = 0
        writer.send(frame.tobytes())
    writer.close()
    return path


def write(clip: Path, folder: Path, rate: float = 1.0) -> int:
    return write_frames(clip, folder, rate, lambda _done, _total: None)


def test_sharpest_frame_of_each_second_is_taken(clip: Path, tmp_path: Path) -> None:
    counted: list[tuple[int, int]] = []
    found = write_frames(clip, tmp_path / "frames", 1.0, lambda *step: counted.append(step))
    assert found == SECONDS and counted[-1][0] == counted[-1][1] == 12 * SECONDS
    photographs = sorted((tmp_path / "frames" / "images").iterdir())
    assert [path.name for path in photographs] == ["00000.jpg", "00001.jpg", "00002.jpg"]
    for number, path in zip(SHARP, photographs, strict=True):
        pixels = np.asarray(Image.open(path).convert("L"))
        assert pixels.shape == (64, 96) and (pixels < 30).mean() > 0.3
        assert abs(int(np.percentile(pixels, 90)) - (60 + 4 * number)) < 6


def test_frames_of_the_same_video_and_rate_stay(clip: Path, tmp_path: Path) -> None:
    assert write(clip, tmp_path / "frames") == 3
    first = tmp_path / "frames" / "images" / "00000.jpg"
    before = first.stat().st_mtime_ns
    assert write(clip, tmp_path / "frames") == 3 and first.stat().st_mtime_ns == before
    with pytest.raises(OutputError, match=r"holds something else than frames of clip\.mp4"):
        write(clip, tmp_path / "frames", 2.0)
    assert write(clip, tmp_path / "more", 2.0) == 2 * SECONDS


def test_blur_makes_pictures_less_sharp() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 1), dtype=np.uint8).repeat(3, axis=2)
    blurred = np.stack([np.roll(noise, k, axis=1) for k in range(4)]).mean(axis=0).astype(np.uint8)
    assert sharpness(blurred) < 0.7 * sharpness(noise)
    assert sharpness(np.full((32, 32, 3), 9, np.uint8)) == 0


def test_what_is_no_video_is_refused(tmp_path: Path) -> None:
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"no film")
    assert is_video(broken) and not is_video(tmp_path / "none.mp4") and not is_video(tmp_path)
    with pytest.raises(DatasetError, match=r"broken\.mp4 cannot be read as a video"):
        write(broken, tmp_path / "frames")
    assert not (tmp_path / "frames").exists()


def test_reconstruction_takes_the_frames_beside_its_output(clip: Path, tmp_path: Path) -> None:
    request = ReconstructRequest(source=clip, output=tmp_path / "run", fps=1)
    assert scene_folder(request) == tmp_path / "run-frames"
    notes: list[str] = []
    with pytest.raises(DatasetError):  # three flat pictures have no poses
        run(request, progress=lambda event: notes.append(event.message) if isinstance(event, Noted) else None)
    assert f"3 frames of clip.mp4 are in {tmp_path / 'run-frames'}." in notes
    assert len(list((tmp_path / "run-frames" / "images").iterdir())) == 3


def test_estimate_counts_the_frames_that_would_be_taken(octasplat, clip: Path) -> None:
    asked = octasplat("estimate", clip, "--fps", "2", "--preset", "fast", "--json")
    assert asked.exit_code == 0, asked.stderr
    found = json.loads(asked.stdout)
    assert found["photographs"] == [{"width_px": 96, "height_px": 64, "count": 2 * SECONDS}]
    assert found["finds_poses"] and found["seconds"] > found["poses_seconds"] > 0
    assert not list(clip.parent.glob("*-frames")) and planned_frames(clip, 0.4).count == 2
    plain = octasplat("estimate", clip)
    assert plain.stdout.startswith("6 photographs: about ")


def test_videos_are_not_sent(octasplat, clip: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OCTASPLAT_SERVER", "http://127.0.0.1:9")
    refused = octasplat("submit", clip)
    assert refused.exit_code == 1 and "reconstruct takes a video" in refused.stderr


def test_two_imports_to_one_folder_leave_each_other_alone(clip: Path, tmp_path: Path) -> None:
    inner: list[int] = []

    def import_too(_done: int, total: int) -> None:
        if _done == total and not inner:
            inner.append(write(clip, tmp_path / "frames"))

    assert write_frames(clip, tmp_path / "frames", 1.0, import_too) == 3 and inner == [3]
    assert len(list((tmp_path / "frames" / "images").iterdir())) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]
