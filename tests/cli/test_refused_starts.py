"""Starts that are refused cost no search for poses, and leave a folder that the corrected command takes."""

import shutil
import time
import unicodedata
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image

from octasplat.engine.poses.photographs import photographs_of_scene
from tests.support.neighbouring_photographs import write_neighbours

PATCH_TOO_LARGE = ("--set", "ssim_patch_side=64", "--set", "loss.ssim=0.2", "--max-side", "32")
"""Settings that the photographs rule out, which is known only when they are open."""


@pytest.fixture
def noise(tmp_path: Path) -> Path:
    """Photographs of nothing: a search for their poses would fail."""
    folder = tmp_path / "photographs"
    folder.mkdir()
    rng = np.random.default_rng(3)
    for number in range(4):
        Image.fromarray(rng.integers(0, 256, (60, 80, 3), dtype=np.uint8)).save(folder / f"{number}.jpg")
    return folder


@pytest.fixture
def posed_copy(scene: Path, tmp_path: Path) -> Path:
    """A copy of the generated scene with its model as text, its first photograph called 0001.png."""
    copy = tmp_path / "scene"
    shutil.copytree(scene, copy)
    model = pycolmap.Reconstruction(str(copy / "sparse/0"))
    shutil.rmtree(copy / "sparse/0")
    (copy / "sparse/0").mkdir()
    model.write_text(str(copy / "sparse/0"))
    first = min((copy / "images").iterdir())
    first.rename(first.with_name("0001.png"))
    text = (copy / "sparse/0/images.txt").read_text()
    (copy / "sparse/0/images.txt").write_text(text.replace(first.name, "0001.png"))
    return copy


def test_unknown_test_view_is_refused_before_pose_search(noise, octasplat, tmp_path, tiny):
    output = tmp_path / "out"
    refused = octasplat("reconstruct", noise, "-o", output, "--held-out", "5.jpg", *tiny)
    assert refused.exit_code == 1
    assert "1 of the images to hold out are not in the photographs (5.jpg)" in refused.stderr
    assert "features" not in refused.stdout and not output.exists()


def test_truncated_photograph_is_refused_before_pose_search(noise, octasplat, tmp_path, tiny):
    whole = (noise / "2.jpg").read_bytes()
    (noise / "2.jpg").write_bytes(whole[: len(whole) // 2])
    refused = octasplat("reconstruct", noise, "-o", tmp_path / "out", *tiny)
    assert refused.exit_code == 1 and "2.jpg is damaged or cut short" in refused.stderr
    assert "replace the file, or take it out of the folder." in refused.stderr
    assert "features" not in refused.stdout and not (tmp_path / "out").exists()


def test_all_truncated_photographs_are_named_at_once(noise, octasplat, tmp_path, tiny):
    for name in ("1.jpg", "3.jpg"):
        whole = (noise / name).read_bytes()
        (noise / name).write_bytes(whole[: len(whole) // 2])
    refused = octasplat("reconstruct", noise, "-o", tmp_path / "out", *tiny)
    assert refused.exit_code == 1
    assert f"2 images in {noise} are damaged, cut short or none at all (1.jpg, 3.jpg);" in refused.stderr
    assert "replace the files, or take them out of the folder." in refused.stderr


@pytest.mark.parametrize("command", ["reconstruct", "estimate"])
def test_all_damaged_photographs_of_a_model_are_named_at_once(posed_copy, octasplat, tmp_path, tiny, command):
    """Those that are no images, and for a training those that end early."""
    names = sorted(path.name for path in (posed_copy / "images").iterdir())
    for name in names[:2]:
        whole = (posed_copy / "images" / name).read_bytes()
        (posed_copy / "images" / name).write_bytes(whole[: len(whole) // 2])
    output = ("-o", tmp_path / "out") if command == "reconstruct" else ()
    if command == "reconstruct":
        refused = octasplat(command, posed_copy, *output, *tiny)
        assert refused.exit_code == 1 and refused.stderr.count("Error") == 1
        told = f"2 images in {posed_copy} are damaged, cut short or none at all (images/{names[0]}, images/"
        assert f"Error: {told}{names[1]}); replace the files." in refused.stderr
        assert not (tmp_path / "out" / "config.json").exists()
    for name in names[3:5]:
        (posed_copy / "images" / name).write_bytes(b"no image")
    refused = octasplat(command, posed_copy, *output, *(tiny if output else ()))
    found = names[:2] + names[3:5] if command == "reconstruct" else names[3:5]
    assert refused.exit_code == 1
    assert f"{len(found)} images in {posed_copy}" in refused.stderr
    assert all(name in refused.stderr for name in found) and names[2] not in refused.stderr


def test_missing_masks_are_refused_before_pose_search(noise, octasplat, tmp_path, tiny):
    refused = octasplat("reconstruct", noise, "-o", tmp_path / "out", "--masks", "alpha", *tiny)
    assert refused.exit_code == 1 and "--masks alpha" in refused.stderr
    assert "features" not in refused.stdout and not (tmp_path / "out").exists()


def test_folder_of_refused_start_is_reused(scene, octasplat, tmp_path, tiny):
    output = tmp_path / "out"
    output.mkdir()
    refused = octasplat("reconstruct", scene, "-o", output, *tiny, *PATCH_TOO_LARGE)
    assert refused.exit_code == 1 and "patch_side" in refused.stderr
    assert [path.name for path in output.iterdir()] == ["cache"]
    done = octasplat("reconstruct", scene, "-o", output, *tiny)
    assert done.exit_code == 0, done.stderr


def test_foreign_cache_folder_is_kept(scene, octasplat, tmp_path, tiny):
    (tmp_path / "out/cache").mkdir(parents=True)
    (tmp_path / "out/cache/letters.txt").write_text("kept")
    refused = octasplat("reconstruct", scene, "-o", tmp_path / "out", *tiny)
    assert refused.exit_code == 1 and "is not empty and holds no run" in refused.stderr
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["cache"]


@pytest.mark.exhaustive
@pytest.mark.heavy
def test_poses_are_kept_when_the_settings_are_refused(octasplat, tmp_path, tiny):
    photographs, output = tmp_path / "photographs", tmp_path / "out"
    write_neighbours(photographs, 7)
    refused = octasplat("reconstruct", photographs, "-o", output, *tiny, *PATCH_TOO_LARGE)
    assert refused.exit_code == 1 and "patch_side" in refused.stderr, refused.output
    found = (output / "poses/images.bin").read_bytes()
    done = octasplat("reconstruct", photographs, "-o", output, "--max-side", "64", *tiny)
    assert done.exit_code == 0, done.stderr
    assert "features" not in done.stdout and (output / "poses/images.bin").read_bytes() == found


@pytest.mark.exhaustive
def test_second_process_on_same_run_is_refused(scene, octasplat, start_octasplat, tmp_path, tiny):
    output = tmp_path / "out"
    settings = [*tiny, "--iterations", "100000"]
    first = start_octasplat("reconstruct", scene, "-o", output, *settings)
    try:
        until = time.monotonic() + 100
        while not (output / "views.json").exists() and time.monotonic() < until:
            time.sleep(0.05)
        second = octasplat("reconstruct", scene, "-o", output, "--resume", *settings)
        assert first.poll() is None
    finally:
        first.kill()
        first.communicate()
    assert second.exit_code == 1
    assert f"Another octasplat works on the run in {output}" in second.stderr


@pytest.mark.parametrize(("option", "value"), [("--seed", "0"), ("--test-every", "0")])
def test_resume_treats_zero_as_setting(scene, octasplat, tmp_path, tiny, option, value):
    output = tmp_path / "out"
    assert octasplat("reconstruct", scene, "-o", output, *tiny, "--seed", "5").exit_code == 0
    refused = octasplat("reconstruct", scene, "-o", output, "--resume", *tiny, option, value)
    assert refused.exit_code == 1 and "other settings" in refused.stderr


def test_run_inside_images_folder_resumes(posed_copy, octasplat, tiny):
    output = posed_copy / "images/run"
    settings = [*tiny, "--held-out", "0001.png"]
    assert octasplat("reconstruct", posed_copy, "-o", output, *settings).exit_code == 0
    assert (output / "renders").is_dir()
    again = octasplat("reconstruct", posed_copy, "-o", output, "--resume")
    assert again.exit_code == 0 and "have no pose" not in again.stderr, again.stderr
    assert all("run/" not in name for name in photographs_of_scene(posed_copy / "images"))


def test_names_to_hold_out_are_compared_however_an_umlaut_is_spelt(posed_copy, octasplat, tmp_path, tiny):
    spelt = {form: unicodedata.normalize(form, "töpfe.png") for form in ("NFC", "NFD")}
    (posed_copy / "images/0001.png").rename(posed_copy / "images" / spelt["NFD"])
    model = posed_copy / "sparse/0/images.txt"
    model.write_text(model.read_text().replace("0001.png", spelt["NFD"]))
    output = tmp_path / "out"
    done = octasplat("reconstruct", posed_copy, "-o", output, *tiny, "--held-out", spelt["NFC"])
    assert done.exit_code == 0, done.stderr
    assert [path.name for path in (output / "renders").iterdir()] == [f"{spelt['NFD'][:-4]}.png"]
    again = octasplat("reconstruct", posed_copy, "-o", output, "--resume", *tiny, "--held-out", spelt["NFD"])
    assert again.exit_code == 0, again.stderr
