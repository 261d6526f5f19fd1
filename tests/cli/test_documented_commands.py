"""The commands of the documentation run, on a scene of some hundred Gaussians and with small pictures."""

import json
import shlex
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

import octasplat as osp
from octasplat.__main__ import cli
from octasplat.engine.dataset.synthetic import SyntheticDatasetConfig, write_synthetic_dataset
from octasplat.engine.poses.photographs import photographs_of_scene, photographs_sha256
from octasplat.engine.render.environment_files import write_environment
from octasplat.engine.render.image_files import write_png
from tests.support.documentation import DOCS, ROOT, DocumentedCommand, commands
from tests.support.located_scene import apply, camera_centres, truth_matrix, write_gps
from tests.support.small_run import RUN_OPTIONS

VERBS = {
    "clean", "config", "crop", "deform", "demo", "edit", "estimate", "evaluate", "export", "import", "info",
    "material", "merge", "plan", "reconstruct", "relight", "render", "simplify", "stage",
    "surface", "transform",
}  # fmt: skip
"""What runs here; the commands of the service have tests of their own."""
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md")), DOCS / "opening" / "blender.md"]
WITH_MATERIALS = {"docs/materials.md"}
LONG = {*WITH_MATERIALS, "docs/results.md"}
FIRST = {"README.md", "docs/first_scene.md"}
"""Pages that a new user reads first, whose trainings run daily."""
TRAINING = {"demo", "reconstruct", "surface"}
PHOTOGRAPHS = (
    "PHOTOS", "PHOTOS/test", "PHOTOGRAPHS", "SITE", "fox", "shiny_knot", "shiny_knot/test",
    "still_life",
)  # fmt: skip
RUNS = ("OUT", "out")
SMALLER = {
    "demo": {"--views": "9", "--width": "48", "--height": "36"},
    "reconstruct": {
        "--iterations": "10",
        "--max-gaussians": "400",
        "--rays-per-batch": "128",
        "--set": "probe_rays=256",
        "--max-side": "48",
        "--exports": "mesh.ply",  # the textured surface of the others takes ten times as long as the training
    },
    "relight": {"--width": "32", "--height": "24", "--samples": "2", "--frames": "2"},
    "render": {"--width": "32", "--height": "24", "--frames": "2"},
    "surface": {"--resolution": "24", "--depth-side": "48", "--min-component": "0"},
}
"""Options that keep a command small; those of the page are replaced."""
REPLACED = {
    "reconstruct": {"--minutes": "0.1", "--known-length": "view_000.png view_005.png 12.5"},
    "surface": {"--texture-size": "128", "--max-triangles": "400"},
}
"""Values that a command has instead of those of the page, if it has the option."""
LIT_SURFACE = {"--texture-size": "128", "--max-triangles": "400"}
"""What a surface with materials has by itself, larger."""


def is_long(command: DocumentedCommand) -> bool:
    """Return whether a command takes long."""
    trains = command.words[0] in TRAINING and (command.page not in FIRST or "--materials" in command.words)
    return command.page in LONG or trains


def runnable() -> list[Any]:
    """Return the commands that can run without a service, each once; those that take long are exhaustive."""
    found = {
        (command.page, command.words): command
        for page in PAGES
        for command in commands(page)
        if command.words and command.words[0] in VERBS
    }
    return [
        pytest.param(command, marks=[pytest.mark.exhaustive] if is_long(command) else [])
        for command in found.values()
    ]


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of nine small photographs with their poses."""
    folder = tmp_path_factory.mktemp("documented") / "photographs"
    config = SyntheticDatasetConfig(views=9, width_px=48, height_px=36, samples_per_side=1, points=300)
    write_synthetic_dataset(folder, config)
    return folder


@pytest.fixture(scope="module")
def plain_run(photographs: Path) -> Path:
    """A finished run without materials."""
    osp.reconstruct(photographs, photographs.parent / "run", **RUN_OPTIONS)
    return photographs.parent / "run"


@pytest.fixture(scope="module")
def materials_run(photographs: Path) -> Path:
    """A finished run with materials."""
    # An iteration with materials takes about as long as forty without.
    few = {**RUN_OPTIONS, "iterations": 10, "rays_per_batch": 128}
    osp.reconstruct(photographs, photographs.parent / "materials_run", **few, materials=True)
    return photographs.parent / "materials_run"


@pytest.fixture
def folder(tmp_path: Path, photographs: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the files that the pages name, as the current one."""
    for name in PHOTOGRAPHS:
        shutil.copytree(photographs, tmp_path / name, dirs_exist_ok=True)
    write_meshes(tmp_path)
    for name in ("studio.hdr", "a.hdr", "b.hdr", "studio.exr"):
        write_environment(tmp_path / name, np.ones((16, 32, 3), np.float32))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def write_meshes(folder: Path) -> None:
    """Write a plane and a box, each at rest and moved, as proxies."""
    grid = [(x, y, 0.0) for x in np.linspace(-3, 3, 4) for y in np.linspace(-3, 3, 4)]
    cells = [(4 * i + j, 4 * i + j + 4, 4 * i + j + 5, 4 * i + j + 1) for i in range(3) for j in range(3)]
    for name, bend in (("rest.ply", 0.0), ("bent.ply", 0.1)):
        vertices = [f"{x} {y} {z + bend * x * x}" for x, y, z in grid]
        header = [
            "ply", "format ascii 1.0", f"element vertex {len(grid)}", "property float x", "property float y",
            "property float z", f"element face {len(cells)}", "property list uchar int vertex_indices",
            "end_header",
        ]  # fmt: skip
        faces = ["4 " + " ".join(map(str, cell)) for cell in cells]
        (folder / name).write_text("\n".join([*header, *vertices, *faces]) + "\n", encoding="ascii")
    (folder / "frames").mkdir()
    for name, height in (("cage.obj", 9.0), ("frames/0.obj", 9.5), ("frames/1.obj", 10.0)):
        corners = [(x, y, z * height) for x in (-9, 9) for y in (-9, 9) for z in (-1, 1)]
        quads = ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
        lines = [*("v {} {} {}".format(*corner) for corner in corners), *(f"f {quad}" for quad in quads)]
        (folder / name).write_text("\n".join(lines) + "\n", encoding="ascii")


def add_scenes(folder: Path, run: Path, words: Sequence[str]) -> None:
    """Put a run and its files where a command expects them."""
    for name in RUNS:
        shutil.copytree(run, folder / name)
    for name in ("scene.ply", "biker.ply", "object.ply", "other.ply", "IN"):
        shutil.copy(run / "scene.ply", folder / name)
    for name in ("edited.ply", "part.ply", "frames/0.ply", "frames/1.ply"):
        shutil.copy(run / "mesh.ply", folder / name)
    if any(word.startswith("OUT/poses/") for word in words):  # as a search finds them in more photographs
        write_found_poses(folder / "PHOTOS", folder / "OUT" / "poses")
    if any(word.startswith("THINGS/") for word in words):  # of a benchmark, which takes minutes
        shutil.copytree(folder / "PHOTOS", folder / "THINGS" / "kettle")
    mask = np.zeros((36, 48, 3), np.float32)
    mask[6:30, 8:40] = 1
    if "--masks" in words:
        (folder / "PHOTOS" / "masks").mkdir()
        for photograph in (folder / "PHOTOS" / "images").iterdir():
            write_png(folder / "PHOTOS" / "masks" / f"{photograph.name}.png", mask)
    if "--mask" in words:
        write_png(folder / words[words.index("--mask") + 1], mask)
    if words[-2:] == ["--georeference", "gps"] or "--control-points" in words:
        write_places(folder / "PHOTOS")
    if "-o" in words:
        remove(folder / words[words.index("-o") + 1])


def write_found_poses(scene: Path, poses: Path) -> None:
    """Write the model of a scene as the first and the second that a search has found."""
    names = photographs_of_scene(scene)
    for target in (poses, poses / "1"):
        shutil.copytree(scene / "sparse" / "0", target, dirs_exist_ok=True)
        record = {"photographs": len(names), "placed": len(names), "left_out": []}
        digest = {"photographs_sha256": photographs_sha256(scene / "images", names)}
        (target / "poses.json").write_text(json.dumps({**record, **digest}), encoding="utf-8")


def write_places(scene: Path) -> None:
    """Write where photographs were taken, into them and as control points."""
    metres = {name: apply(truth_matrix(), centre) for name, centre in camera_centres(scene).items()}
    write_gps(scene, metres)
    rows = [",".join([name, *map(repr, place.tolist())]) for name, place in metres.items()]
    (scene / "targets.csv").write_text("\n".join(["name,x,y,z", *rows]) + "\n", encoding="utf-8")


def remove(path: Path) -> None:
    """Remove what a command is going to write, as the first reader of a page has not got it."""
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def small(words: Sequence[str]) -> list[str]:
    """Return a command with options that keep it small."""
    options, replaced = SMALLER.get(words[0], {}), REPLACED.get(words[0], {})
    if words[0] == "surface" and "--materials" in words:
        options, replaced = {**options, **LIT_SURFACE}, {}
    found: list[str] = []
    before = ""
    for word in words:
        if before in replaced:
            found.append(replaced[before])
        elif word not in options and before not in options:
            found.append(word)
        before = word
    added = [part for pair in options.items() for part in pair if not _has_no_use(words, pair[0])]
    return [*found, *added]


def _has_no_use(words: Sequence[str], option: str) -> bool:
    """Return whether a command would refuse an option for small pictures."""
    is_file = words[1].endswith(".ply")  # of which there is a turntable unless cameras are named
    moves = "--turntable" in words or (is_file and "--camera" not in words)
    if option == "--frames":
        return not moves
    if option in ("--width", "--height") and words[0] in ("render", "relight"):
        return not moves and "--camera" not in words
    return False


@pytest.mark.heavy
@pytest.mark.parametrize("command", runnable(), ids=str)
def test_command_of_a_page_runs(
    command: DocumentedCommand, folder: Path, request: pytest.FixtureRequest
) -> None:
    words = list(command.words)
    run = "materials_run" if command.page in WITH_MATERIALS else "plain_run"
    add_scenes(folder, request.getfixturevalue(run), words)
    if "--stage" in words:
        run_cli("stage", "init", words[1], "-o", "stage.toml")
    if "--resume" in words:
        run_cli(*small([word for word in words if word != "--resume"]))
    run_cli(*small(words))


def run_cli(*words: str) -> None:
    """Run a command of octasplat; it must end well."""
    result = CliRunner().invoke(cli, words)
    assert result.exit_code == 0, f"octasplat {shlex.join(words)}\n{result.output}"
