"""``octasplat render``."""

import json
import re
import signal
import subprocess
import time
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.files import read_metadata
from octasplat.engine.files.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from octasplat.engine.render.image_files import read_image
from tests.support.image_channels import read_channels
from tests.support.light_scenes import shiny_ball

SIZE = ("--width", 32, "--height", 24)


def test_held_out_views_are_those_of_the_evaluation(run, octasplat, tmp_path):
    result = octasplat("render", run.output, "-o", tmp_path / "new")
    assert result.exit_code == 0, result.output
    for old in (run.output / "renders").iterdir():
        again = read_image(tmp_path / "new" / old.name)
        assert np.abs(again - read_image(old)).max() <= 2 / 255, old.name


@pytest.mark.parametrize(("which", "count"), [("held-out", 2), ("train", 6), ("all", 8)])
def test_views_and_their_size(run, octasplat, tmp_path, which, count):
    result = octasplat("render", run.output, "-o", tmp_path, "--views", which, "--max-side", 32)
    assert result.exit_code == 0, result.output
    files = list(tmp_path.glob("*.png"))
    assert len(files) == count
    assert read_image(files[0]).shape == (24, 32, 3)


def test_antialiased_small_render_equals_downscaled_large(run, octasplat, tmp_path):
    for name, size in (("large", ()), ("small", ("--max-side", 16))):
        assert octasplat("render", run.output, "-o", tmp_path / name, *size).exit_code == 0
    paths = list((tmp_path / "small").iterdir())
    assert paths
    for path in paths:
        large, small = read_image(tmp_path / "large" / path.name), read_image(path)
        wanted = large.reshape(12, large.shape[0] // 12, 16, large.shape[1] // 16, 3).mean(axis=(1, 3))
        assert np.abs(small - wanted).mean() < 1 / 255


def test_views_of_a_run_whose_photographs_moved(run, octasplat, tmp_path):
    moved = tmp_path / "moved"
    moved.symlink_to(run.scene)
    result = octasplat("render", run.output, "-o", tmp_path / "out", "--dataset", moved, "--quiet")
    assert result.exit_code == 0, result.output
    assert result.output == ""


@pytest.mark.parametrize("bare", [False, True])
def test_render_turntable_writes_video(run, octasplat, tmp_path, bare):
    source = run.output / "scene.ply" if bare else run.output
    video = tmp_path / "turn.mp4"
    result = octasplat("render", source, "-o", video, "--turntable", "--frames", 4, *SIZE)
    assert result.exit_code == 0, result.output
    frames = decode(video, 32, 24)
    assert len(frames) == 4
    assert frames.std() > 1, "the images are empty"


def test_render_seconds_and_fps_set_frame_count(run, octasplat, tmp_path):
    result = octasplat(
        "render", run.output / "scene.ply", "-o", tmp_path / "f%02d.png", "--seconds", 0.5, "--fps", 6,
        "--up", "z", *SIZE,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["f00.png", "f01.png", "f02.png"]


def test_exr_has_depth_and_normals(run, octasplat, tmp_path):
    result = octasplat("render", run.output, "-o", tmp_path, "--turntable", "--frames", 1, "--exr", *SIZE)
    assert result.exit_code == 0, result.output
    layers = read_channels(tmp_path / "frame_0000.exr")
    assert set(layers) == {"R", "G", "B", "A", "Z", "N.x", "N.y", "N.z"}
    seen = layers["A"] > 0.5
    assert seen.any()
    assert (layers["Z"][seen] > 0).all()
    length = np.sqrt(sum(layers[f"N.{axis}"] ** 2 for axis in "xyz"))
    np.testing.assert_allclose(length[seen], 1, atol=1e-3)


def test_run_and_scene_file_render_same_image(run, octasplat, tmp_path):
    gaussians, _ = read_gaussian_ply(run.output / "scene.ply")
    facts = read_metadata(run.output)
    near = facts.near_world
    assert near > 0
    assert facts.pixel_rad > 0
    # Right before the largest thing: what is nearer than the training saw is not to be seen in either.
    nearest = int(np.argmax(gaussians.opacities * gaussians.scales.prod(axis=1)))
    pose = np.eye(4)
    pose[:3, 3] = gaussians.means_world[nearest] - [0, 0, 0.5 * near]
    path = write_path(tmp_path / "cameras.json", pose)
    shown = []
    for source in (run.output, run.output / "scene.ply"):
        pattern = tmp_path / source.name / "%d.png"
        result = octasplat("render", source, "-o", pattern, "--path", path, "--background", "white")
        assert result.exit_code == 0, result.output
        shown.append(read_image(pattern.with_name("0.png")))
    np.testing.assert_array_equal(*shown)
    bare = tmp_path / "bare.ply"
    write_gaussian_ply(gaussians, bare)
    assert (
        octasplat(
            "render", bare, "-o", tmp_path / "%d.png", "--path", path, "--background", "white"
        ).exit_code
        == 0
    )
    assert np.abs(read_image(tmp_path / "0.png") - shown[0]).max() > 0.05, (
        "nothing lay before the near distance"
    )


def test_render_background_sets_empty_pixels(run, octasplat, tmp_path):
    up = np.eye(4)
    up[:3, 3] = (0, 0, 50)  # above everything, looking up
    path = write_path(tmp_path / "cameras.json", up)
    for name, value in (("white", 1), ("black", 0)):
        result = octasplat(
            "render", run.output / "scene.ply", "-o", tmp_path / name, "--path", path, "--background", name
        )
        assert result.exit_code == 0, result.output
        assert (read_image(tmp_path / name / "frame_0000.png") == value).all()


def test_camera_path_as_video(run, octasplat, tmp_path):
    path = write_path(tmp_path / "cameras.json", np.eye(4), frames=3)
    result = octasplat("render", run.output, "-o", tmp_path / "fly.mp4", "--path", path)
    assert result.exit_code == 0, result.output
    assert len(decode(tmp_path / "fly.mp4", 32, 24)) == 3


def documented_path():
    """The example of the document."""
    text = (Path(__file__).resolve().parents[2] / "docs/cameras.md").read_text()
    (example,) = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    return example


def test_documented_camera_path_renders_same_with_both_lenses(run, octasplat, tmp_path):
    path = tmp_path / "cameras.json"
    path.write_text(documented_path())
    result = octasplat("render", run.output, "-o", tmp_path / "frames", "--path", path)
    assert result.exit_code == 0, result.output
    images = [read_image(tmp_path / f"frames/frame_{number:04d}.png") for number in (0, 1)]
    assert all(image.shape == (48, 64, 3) and image.std() > 0.01 for image in images)
    # The second lens is the first one's in pixels, as the document has it: f = 24 / tan 25 degrees.
    content = json.loads(path.read_text())
    second = content["frames"][1]
    for name in ("fx", "fy", "cx", "cy"):
        del second[name]
    path.write_text(json.dumps({**content, "frames": [{**second, "fov_y_degrees": 50}]}))
    result = octasplat("render", run.output, "-o", tmp_path / "again", "--path", path)
    assert result.exit_code == 0, result.output
    assert np.abs(read_image(tmp_path / "again/frame_0000.png") - images[1]).mean() < 0.01


def test_render_invalid_camera_path_is_named(run, octasplat, tmp_path):
    path = tmp_path / "cameras.json"
    path.write_text(documented_path().replace("camera_to_world", "pose"))
    result = octasplat("render", run.output, "-o", tmp_path / "frames", "--path", path)
    assert result.exit_code == 1
    assert str(path) in result.stderr and "docs/cameras.md" in result.stderr
    assert "docs/cameras.md" in octasplat("render", "--help").stdout


@pytest.mark.parametrize(
    "arguments",
    [
        ["-o", "turn.mp4", "--views", "all"],
        ["-o", "turn.mp4", "--turntable", "--exr"],
        ["-o", "one.png", "--turntable"],
        ["-o", "some_%d.png", "--exr"],
        ["-o", "out", "--turntable", "--views", "all"],
        ["-o", "out", "--turntable", "--frames", "3", "--seconds", "3"],
        ["-o", "one.mp4", "--camera", "0", "0", "1"],
        ["-o", "one.png", "--camera", "0", "0", "1", "--distance", "3"],
        ["-o", "out", "--views", "all", "--look-at", "0", "0", "1"],
        ["-o", "one.mp4", "--turntable", "--background", "transparent"],
        ["-o", "one.jpg", "--camera", "0", "0", "1"],
    ],
)
def test_contradictions_are_usage_errors(run, octasplat, arguments):
    assert octasplat("render", run.output, *arguments).exit_code == 2


@pytest.mark.parametrize("bare", [False, True])
def test_render_single_camera_writes_one_file(run, octasplat, tmp_path, bare):
    source = run.output / "scene.ply" if bare else run.output
    result = octasplat(
        "render", source, "-o", tmp_path / "still.png", "--camera", 12, 12, 8, "--look-at", 0, 0, 0,
        "--up", "z", "--background", "transparent", *SIZE,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert [path.name for path in tmp_path.iterdir()] == ["still.png"]
    image = read_image(tmp_path / "still.png")
    assert image.shape == (24, 32, 4)
    assert image[..., 3].min() < 0.1 < 0.9 < image[..., 3].max()
    # Over black it is the picture with a black background.
    result = octasplat(
        "render", source, "-o", tmp_path / "%d.exr", "--camera", 12, 12, 8, "--look-at", 0, 0, 0, "--up", "z",
        "--background", "black", *SIZE,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    black = linear_to_srgb(np.stack([read_channels(tmp_path / "0.exr")[name] for name in "RGB"], axis=-1))
    np.testing.assert_allclose(image[..., :3] * image[..., 3:], black, atol=0.02)


def test_distance_and_elevation_of_a_turntable(run, octasplat, tmp_path):
    depths = []
    for distance in (20, 40):
        result = octasplat(
            "render", run.output / "scene.ply", "-o", tmp_path / f"{distance}.exr", "--turntable",
            "--frames", 1, "--distance", distance, "--elevation", 80, "--look-at", 0, 0, 0,
            "--up", "z", *SIZE,
        )  # fmt: skip
        assert result.exit_code == 0, result.output
        layers = read_channels(tmp_path / f"{distance}.exr")
        depths.append(np.median(layers["Z"][layers["A"] > 0.5]))
    assert depths[1] - depths[0] == pytest.approx(20, rel=0.05)


def test_several_images_do_not_go_to_one_file(run, octasplat, tmp_path):
    path = write_path(tmp_path / "cameras.json", np.eye(4), frames=2)
    result = octasplat("render", run.output, "-o", tmp_path / "one.png", "--path", path)
    assert result.exit_code == 1 and "one_%04d.png" in result.stderr
    assert not (tmp_path / "one.png").exists()


def test_views_of_a_bare_ply_are_refused(run, octasplat, tmp_path):
    result = octasplat("render", run.output / "scene.ply", "-o", tmp_path / "out", "--views", "all")
    assert result.exit_code == 2


@pytest.mark.parametrize("source", ["none.ply", "."])
def test_render_not_a_scene_is_refused(octasplat, tmp_path, source):
    result = octasplat("render", tmp_path / source, "-o", tmp_path / "out")
    assert result.exit_code == 1
    assert result.stderr.startswith("Error: ") and result.stderr.count("\n") == 1


def write_path(path, pose, frames=1):
    frame = {"camera_to_world": pose.tolist(), "fov_y_degrees": 40}
    path.write_text(json.dumps({"width": 32, "height": 24, "frames": [frame] * frames}))
    return path


def decode(video, width, height):
    """All frames of a video as bytes."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", str(video)]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3)


@pytest.mark.exhaustive
def test_sigterm_stops_a_render_with_a_sentence(start_octasplat, tmp_path):
    ball = shiny_ball(200, 1.0, albedo=(1.0, 1.0, 1.0), metallic=0.0, roughness=1.0)
    write_gaussian_ply(ball.without_channels(list(ball.channels)), tmp_path / "ball.ply")
    turn = ("--turntable", "--frames", 5000, "--width", 64, "--height", 64, "-o", tmp_path / "turn")
    process = start_octasplat("render", tmp_path / "ball.ply", *turn)
    end = time.monotonic() + 120
    while not any(tmp_path.glob("turn/*.png")):
        assert process.poll() is None and time.monotonic() < end, process.communicate()
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 143
    assert stderr == "Stopped while rendering; the same command with --resume goes on.\n"
