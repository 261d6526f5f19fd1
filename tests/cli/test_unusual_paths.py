"""Paths of another kind than a command expects, and names that are no text."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from octasplat.engine.operations.reconstruct import ReconstructRequest, scene_folder


@pytest.mark.parametrize("command", ["estimate", "plan", "reconstruct"])
@pytest.mark.parametrize("name", ["photograph.png", "missing[1]"])
def test_dataset_that_is_no_folder_is_refused_in_a_sentence(octasplat, tmp_path: Path, command, name) -> None:
    (tmp_path / "photograph.png").write_bytes(b"")
    output = ("-o", tmp_path / "run") if command == "reconstruct" else ()
    result = octasplat(command, tmp_path / name, *output)
    assert result.exit_code == 1, result.output
    assert result.stderr == (
        f"Error: {tmp_path / name} is not a folder; name the folder that holds the photographs.\n"
    )
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("command", ["estimate", "plan", "reconstruct"])
def test_archive_is_refused_with_what_to_do(octasplat, tmp_path: Path, command) -> None:
    (tmp_path / "photos.zip").write_bytes(b"PK")
    output = ("-o", tmp_path / "run") if command == "reconstruct" else ()
    result = octasplat(command, tmp_path / "photos.zip", *output)
    assert result.exit_code == 1
    assert f"{tmp_path / 'photos.zip'} is an archive; unpack it" in result.stderr
    assert "octasplat submit" in result.stderr


UNDECODABLE = os.fsdecode(b"\xff\xfe.ply")
"""A name of bytes that are no UTF-8, as of files from other systems."""


@pytest.fixture
def undecodable(run, tmp_path: Path) -> Path:
    """A copy of a scene under such a name."""
    path = tmp_path / UNDECODABLE
    shutil.copy(run.output / "scene.ply", path)
    return path


def test_name_that_is_no_text_is_written_and_replaced(octasplat, undecodable: Path, tmp_path: Path) -> None:
    output = tmp_path / os.fsdecode(b"clean\xff.ply")
    for _ in range(2):  # the second time it is known as ours
        result = octasplat("clean", undecodable, "-o", output, "--quiet")
        assert result.exit_code == 0, result.output
    output.write_bytes(b"changed")
    assert octasplat("clean", undecodable, "-o", output, "--quiet").exit_code == 1


def test_name_that_is_no_text_is_escaped_in_json(octasplat, undecodable: Path) -> None:
    result = octasplat("info", undecodable, "--json")
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["source"] == str(undecodable)


@pytest.mark.exhaustive
def test_name_that_output_cannot_show_is_escaped(undecodable: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "octasplat", "info", undecodable],
        env={**os.environ, "PYTHONIOENCODING": "utf-8:strict"},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert rb"\udcff\udcfe.ply: " in done.stdout


def test_pictures_whose_paths_are_no_text_are_refused_in_a_sentence(octasplat, run, tmp_path: Path) -> None:
    output = tmp_path / os.fsdecode(b"run\xff")
    refused = octasplat("reconstruct", run.scene, "-o", output)
    assert refused.exit_code == 1 and "the path is no text" in refused.stderr, refused.output
    assert not output.exists()

    camera = ("--camera", "0", "0", "-4", "--width", "16", "--height", "16")
    image = octasplat("render", run.output, *camera, "-o", tmp_path / os.fsdecode(b"view\xff.png"))
    assert image.exit_code == 1 and "its path is no text; choose another" in image.stderr, image.output

    photographs = tmp_path / os.fsdecode(b"scene\xff")
    shutil.copytree(run.scene, photographs)
    read = octasplat("reconstruct", photographs, "-o", tmp_path / "other")
    assert read.exit_code == 1 and "its path is no text; rename it" in read.stderr, read.output


@pytest.mark.parametrize("name", [".", "inner/.."])
def test_frames_of_a_video_are_beside_the_folder_that_has_no_name_of_its_own(
    tmp_path: Path, monkeypatch, name: str
) -> None:
    (tmp_path / "here/inner").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "here")
    Path("film.mp4").touch()
    request = ReconstructRequest(source=Path("film.mp4"), output=Path(name))
    assert scene_folder(request) == tmp_path / "here-frames"


@pytest.mark.parametrize("verb", ["reconstruct", "estimate", "plan"])
def test_renders_of_a_run_are_no_photographs(octasplat, tmp_path, verb):
    for name in ("config.json", "events.jsonl"):
        (tmp_path / name).write_text("{}")
    result = octasplat(verb, tmp_path, *(("-o", tmp_path / "out") if verb == "reconstruct" else ()))
    assert result.exit_code == 1
    assert result.stderr.startswith(f"Error: {tmp_path} is the folder of a run; name the folder that holds")
