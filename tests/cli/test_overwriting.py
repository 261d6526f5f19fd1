"""Nothing that was read is written, and nothing that octasplat did not write is replaced unasked."""

import json
import shutil
from pathlib import Path

import pytest
from PIL import Image

from octasplat.engine.files.gaussian_ply import read_gaussian_ply

NOT_OURS = b"somebody else's"


@pytest.fixture
def here(run, tmp_path: Path) -> Path:
    """A folder with a scene as a file, the run that it is of, and the photographs of that run."""
    shutil.copytree(run.scene, tmp_path / "photographs")
    shutil.copytree(run.output, tmp_path / "run")
    config = json.loads((tmp_path / "run/config.json").read_text())
    (tmp_path / "run/config.json").write_text(json.dumps({**config, "scene": str(tmp_path / "photographs")}))
    shutil.copy(run.output / "scene.ply", tmp_path / "scene.ply")
    (tmp_path / "matrix.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 1\n")
    return tmp_path


ONE_IMAGE = ("--camera", "0", "0", "-4", "--width", "32", "--height", "24")
READS = {
    "crop": ("crop", "scene.ply", "--where", "opacity > 0", "-o", "scene.ply"),
    "clean": ("clean", "scene.ply", "-o", "scene.ply"),
    "simplify": ("simplify", "scene.ply", "-n", "50", "-o", "scene.ply"),
    "transform": ("transform", "run", "--scale", "2", "-o", "run/scene.ply"),
    "transform's matrix": ("transform", "scene.ply", "--matrix", "matrix.txt", "-o", "matrix.ply"),
    "merge": ("merge", "scene.ply", "run", "-o", "run/scene.ply"),
    "export": ("export", "scene.ply", "scene.ply"),
    "export of a run": ("export", "run", "new.splat", "run/scene.ply"),
    "import": ("import", "scene.ply", "scene.ply"),
    "render": ("render", "run", "--views", "all", "-o", "photographs/images"),
    "render to new names": ("render", "run", *ONE_IMAGE, "-o", "photographs/images/new"),
    "surface": ("surface", "scene.ply", "-o", "scene.ply"),
    "info": ("info", "scene.ply", "-o", "scene.ply"),
    "info of a run": ("info", "run", "-o", "run/config.json"),
    "report": ("edit", "scene.ply", "--mesh", "mesh.ply", "-o", "new.ply", "--report", "scene.ply"),
    "deform": ("deform", "scene.ply", "--proxy", "p.obj", "--deformed", "d.ply", "-o", "d.ply"),
}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("overwrite", [(), ("--overwrite",)], ids=["", "overwrite"])
@pytest.mark.parametrize("name", READS)
def test_output_over_input_is_refused(here, octasplat, monkeypatch, name, overwrite):
    monkeypatch.chdir(here)
    assert octasplat("export", "scene.ply", "mesh.ply", "--format", "mesh-ply").exit_code == 0
    for copy in ("p.obj", "d.ply", "matrix.ply"):
        shutil.copy("mesh.ply", copy)
    if name == "transform's matrix":
        Path("matrix.ply").write_bytes(Path("matrix.txt").read_bytes())
        arguments = tuple("matrix.ply" if word == "matrix.txt" else word for word in READS[name])
    else:
        arguments = READS[name]
    before = contents(here)
    refused = octasplat(*arguments, *overwrite)
    assert refused.exit_code == 1 and "would overwrite what the command reads" in refused.stderr, refused
    assert contents(here) == before


FOREIGN = {
    "crop": (("crop", "scene.ply", "--where", "opacity > 0", "-o", "x.ply"), "x.ply"),
    "export": (("export", "scene.ply", "x.splat", "x.obj"), "x.splat"),
    "export's texture": (("export", "scene.ply", "x.obj"), "x_alpha.png"),
    "import": (("import", "scene.ply", "x.ply"), "x.ply"),
    "render": (("render", "scene.ply", *ONE_IMAGE, "-o", "x.png"), "x.png"),
    "render to a folder": (("render", "scene.ply", *ONE_IMAGE, "-o", "x"), "x/frame_0000.png"),
    "info": (("info", "scene.ply", "--picture", "x.png"), "x.png"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_foreign_file_is_replaced_only_with_overwrite(here, octasplat, monkeypatch, name):
    monkeypatch.chdir(here)
    arguments, place = FOREIGN[name]
    Path(place).parent.mkdir(exist_ok=True)
    Path(place).write_bytes(NOT_OURS)
    before = contents(here)
    refused = octasplat(*arguments)
    assert refused.exit_code == 1, refused.output
    assert f"{place} is there already" in refused.stderr and "--overwrite" in refused.stderr
    assert contents(here) == before
    done = octasplat(*arguments, "--overwrite")
    assert done.exit_code == 0, done.output
    assert Path(place).read_bytes() != NOT_OURS
    again = octasplat(*arguments)  # what octasplat wrote is replaced as ever
    assert again.exit_code == 0, again.output
    Path(place).write_bytes(NOT_OURS)  # until it is changed
    assert octasplat(*arguments).exit_code == 1 and Path(place).read_bytes() == NOT_OURS


def test_surface_texture_keeps_foreign_image(here, octasplat, monkeypatch):
    monkeypatch.chdir(here)
    Image.new("RGB", (4, 4)).save("chair.png")
    before = Path("chair.png").read_bytes()
    refused = octasplat("surface", "scene.ply", "-o", "chair.obj", "--texture-size", "64")
    assert refused.exit_code == 1 and "chair.png is there already" in refused.stderr, refused.output
    assert Path("chair.png").read_bytes() == before and not Path("chair.obj").exists()


def test_foreign_files_among_frames_are_kept(here, octasplat, monkeypatch):
    monkeypatch.chdir(here)
    Path("turn.mp4.frames").mkdir()
    Path("turn.mp4.frames/notes.txt").write_bytes(NOT_OURS)
    film = ("render", "scene.ply", "-o", "turn.mp4", "--frames", "2", "--width", "32", "--height", "24")
    assert octasplat(*film).exit_code == 0
    assert contents(here / "turn.mp4.frames") == {"notes.txt": NOT_OURS}
    Path("other.mp4.frames").mkdir()
    Path("other.mp4.frames/000001.png").write_bytes(NOT_OURS)
    refused = octasplat(*[word.replace("turn.mp4", "other.mp4") for word in film])
    assert refused.exit_code == 1 and "000001.png is there already" in refused.stderr
    assert contents(here / "other.mp4.frames") == {"000001.png": NOT_OURS}


@pytest.mark.parametrize("folder", ["depths", "depth", "input"])
def test_every_folder_of_a_scene_is_kept(here, octasplat, monkeypatch, folder):
    monkeypatch.chdir(here)
    (here / "photographs" / folder).mkdir()
    refused = octasplat("render", "run", *ONE_IMAGE, "-o", f"photographs/{folder}/new")
    assert refused.exit_code == 1 and "would overwrite what the command reads" in refused.stderr, refused


def test_output_of_other_kind_is_kept(here, octasplat, monkeypatch):
    monkeypatch.chdir(here)
    assert octasplat("crop", "scene.ply", "--where", "opacity > 0", "-o", "x.ply").exit_code == 0
    assert octasplat("transform", "scene.ply", "--scale", "2", "-o", "x.ply").exit_code == 0
    refused = octasplat("surface", "scene.ply", "-o", "x.ply")
    assert refused.exit_code == 1 and "x.ply is there already" in refused.stderr


def test_stage_file_is_kept_without_overwrite(here, octasplat, monkeypatch):
    monkeypatch.chdir(here)
    stage = ("stage", "init", "scene.ply", "-o", "x.toml")
    assert octasplat(*stage).exit_code == 0
    refused = octasplat(*stage)
    assert refused.exit_code == 1 and "x.toml is there already" in refused.stderr
    assert octasplat(*stage, "--overwrite").exit_code == 0


def test_python_has_the_same_guard(here, monkeypatch):
    import octasplat as osp

    monkeypatch.chdir(here)
    with pytest.raises(osp.ConfigError, match="would overwrite what the command reads"):
        osp.crop("scene.ply", "scene.ply", where="opacity > 0")
    Path("x.ply").write_bytes(NOT_OURS)
    with pytest.raises(osp.OctasplatError, match=r"x\.ply is there already"):
        osp.crop("scene.ply", "x.ply", where="opacity > 0")
    osp.crop("scene.ply", "x.ply", where="opacity > 0", overwrite=True)
    osp.crop("scene.ply", "x.ply", where="opacity > 0")
    assert len(read_gaussian_ply(Path("x.ply"))[0]) > 0


@pytest.mark.parametrize(
    "arguments",
    [
        ("render", "scene.ply", *ONE_IMAGE, "-o", "taken"),
        ("render", "scene.ply", "--turntable", "--frames", "2", "-o", "taken/film.mp4"),
        ("info", "scene.ply", "-o", "taken/facts.json"),
        ("clean", "scene.ply", "-o", "taken/below/clean.ply"),
    ],
)
def test_file_in_the_place_of_the_output_folder_is_named(octasplat, here, monkeypatch, arguments) -> None:
    monkeypatch.chdir(here)
    (here / "taken").write_bytes(NOT_OURS)
    result = octasplat(*arguments)
    assert result.exit_code == 1, result.output
    assert "as taken is a file; choose another place." in result.stderr
    assert (here / "taken").read_bytes() == NOT_OURS
