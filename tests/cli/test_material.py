"""``octasplat material``: other materials for chosen Gaussians of a run or a file."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from pydantic import ValidationError

from octasplat.engine.core.color import linear_to_srgb
from octasplat.engine.files import export_scene, read_mesh
from octasplat.engine.files.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from octasplat.engine.render.environment_files import write_environment
from octasplat.engine.render.image_files import read_image
from octasplat.workers.worker.handlers import run_operation
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.task import Task

VIEW = "view_000"


def scene_of(path: Path):
    return read_gaussian_ply(path / "scene.ply" if path.is_dir() else path)[0]


@pytest.fixture(scope="module")
def changed(shiny_run, octasplat, tmp_path_factory) -> Path:
    """The run with a half of it matt and orange."""
    output = tmp_path_factory.mktemp("changed") / "run"
    done = octasplat(
        "material", shiny_run, "-o", output, "--set", "albedo=#ff8000", "--set", "metallic=0",
        "--multiply", "roughness=1.5", "--where", "x > 0 and roughness < 0.6",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    count = int((scene_of(shiny_run).means_world[:, 0] > 0).sum())
    assert f"{count:,} of {len(scene_of(shiny_run)):,} Gaussians changed" in done.output
    return output


def test_material_changes_selected_gaussians_only(shiny_run, changed):
    before, after = scene_of(shiny_run), scene_of(changed)
    chosen = before.means_world[:, 0] > 0
    assert 0 < chosen.sum() < len(chosen)
    shown = linear_to_srgb(after.channels["albedo"][chosen])
    np.testing.assert_allclose(shown, np.tile([1, 128 / 255, 0], (chosen.sum(), 1)), atol=1e-6)
    assert (after.channels["metallic"][chosen] == 0).all() and (
        after.channels["roughness"][chosen] == 0.75
    ).all()
    for name in ("means_world", "quats_wxyz", "log_scales", "opacity_logits"):
        assert (getattr(before, name) == getattr(after, name)).all()
    for name in before.channels:
        assert (before.channels[name][~chosen] == after.channels[name][~chosen]).all()
    assert (before.sh[~chosen] == after.sh[~chosen]).all() and (before.sh[chosen] != after.sh[chosen]).any()


def test_material_output_folder_is_a_run(shiny_run, changed, octasplat, tmp_path):
    assert not (changed / "metrics.json").exists()
    assert (changed / "environment.hdr").read_bytes() == (shiny_run / "environment.hdr").read_bytes()
    [note] = json.loads((changed / "edits.json").read_text())
    assert note["operation"] == "material" and note["gaussians"] > 0
    assert note["where"] == "x > 0 and roughness < 0.6" and note["set"]["metallic"] == 0
    light = ("--environment", changed / "environment.hdr", "--integrator", "path", "--samples", 4)
    for run, name in ((shiny_run, "old"), (changed, "new")):
        assert octasplat("relight", run, *light, "-o", tmp_path / name).exit_code == 0
    old, new = (read_image(tmp_path / name / f"{VIEW}.png") for name in ("old", "new"))
    orange = (new[..., 0] - new[..., 2]) - (old[..., 0] - old[..., 2])
    assert (orange > 0.2).mean() > 0.1
    assert octasplat("render", changed, "-o", tmp_path / "views").exit_code == 0
    assert octasplat("export", changed, tmp_path / "mesh.glb").exit_code == 0
    done = octasplat("evaluate", changed)
    assert done.exit_code == 0 and (changed / "metrics.json").exists(), done.output
    assert "scene.ply" in done.output and "mesh.obj" not in done.output  # which the command did not make
    done = octasplat("material", changed, "-o", tmp_path / "again", "--set", "roughness=1")
    assert done.exit_code == 0 and len(json.loads((tmp_path / "again" / "edits.json").read_text())) == 2


def test_material_job_matches_command_bytes(shiny_run, changed, tmp_path):
    shutil.copytree(shiny_run, tmp_path / "attempt" / "run")
    asked = {
        "set": {"albedo": "#ff8000", "metallic": 0}, "multiply": {"roughness": 1.5},
        "where": "x > 0 and roughness < 0.6",
    }  # fmt: skip
    options = get_job_kind("material").resolve(asked)
    dumped = options.model_dump(mode="json")
    run_operation(Task(tmp_path / "attempt", dumped, title="a thing", threads=1, kind="material"))
    results = tmp_path / "attempt" / "results"
    assert (results / "scene.ply").read_bytes() == (changed / "scene.ply").read_bytes()
    assert (results / "edits.json").read_bytes() == (changed / "edits.json").read_bytes()
    assert json.loads((results / "config.json").read_text())["scene"] == "a thing"
    for kind in ("relight", "material", "render", "evaluate"):  # what it is given is among these results
        wanted = set(get_job_kind(kind).source_files) - {
            "edits.json", "background.exr", "residual.npz", "georeference.json",
        }  # fmt: skip
        assert wanted <= {path.name for path in results.iterdir()}, kind
    for wrong in ({}, {"set": {"roughness": 2}}, {**asked, "where": "open(1) > 2"}):
        with pytest.raises(ValidationError):
            get_job_kind("material").resolve(wrong)


def test_material_job_uses_uploaded_masks(shiny_run, octasplat, tmp_path):
    mask = np.zeros((96, 128), np.uint8)
    mask[:, :64] = 255
    (tmp_path / "attempt" / "files").mkdir(parents=True)
    Image.fromarray(mask).save(tmp_path / "attempt" / "files" / f"{VIEW}.png")
    done = octasplat(
        "material", shiny_run, "-o", tmp_path / "new", "--set", "metallic=0", "--inverse",
        "--mask", tmp_path / "attempt" / "files" / f"{VIEW}.png",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    shutil.copytree(shiny_run, tmp_path / "attempt" / "run")
    kind = get_job_kind("material")
    options = kind.resolve({"set": ["metallic=0"], "inverse": True, "masks": [f"{VIEW}.png"]})
    assert list(kind.named_files(options)) == [("masks.0", f"{VIEW}.png")] and kind.takes_files
    run_operation(Task(tmp_path / "attempt", options.model_dump(mode="json"), threads=1, kind="material"))
    for name in ("scene.ply", "edits.json"):
        changed = (tmp_path / "attempt" / "results" / name).read_bytes()
        assert changed == (tmp_path / "new" / name).read_bytes(), name
    without = kind.resolve({"set": {"metallic": 0}}).model_dump(mode="json")
    assert not {"mesh", "masks"} & without.keys()  # which workers of the last version do not know


def test_material_change_reverted_restores_appearance(changed, shiny_run, octasplat, tmp_path):
    """What is changed back looks as before, and in white light white metal is brighter than black."""
    light = np.full((16, 32, 3), 0.5, np.float32)
    write_environment(changed / "environment.hdr", light)
    done = octasplat(
        "material", changed, "-o", tmp_path / "back", "--set", "albedo=.25,.25,.25", "--set", "metallic=1",
        "--set", "roughness=.5", "--where", "metallic == 0",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    before, after = scene_of(shiny_run), scene_of(tmp_path / "back")
    np.testing.assert_allclose(after.sh, before.sh, atol=2e-6)
    done = octasplat("material", shiny_run, "-o", tmp_path / "white", "--set", "albedo=1,1,1")
    assert done.exit_code == 0, done.output
    gain = scene_of(tmp_path / "white").base_rgb_srgb - before.base_rgb_srgb
    # Half as bright as the light at 0.25 and 0.5 of it, nearly all of it at 1: metal of roughness 0.5.
    assert 0.2 < np.median(gain) < 0.45


def test_material_file_follows_partly_deleted_mesh(shiny_run, octasplat, tmp_path):
    scene = shiny_run / "scene.ply"
    export_scene(scene_of(scene), tmp_path / "mesh.ply", format="mesh-ply")
    mesh = read_mesh(tmp_path / "mesh.ply")
    kept = mesh.gid % 3 == 0
    rows = [f"{x:.9g} {y:.9g} {z:.9g} {g:g} {c:g}" for (x, y, z), g, c in zip(
        mesh.vertices[kept], mesh.gid[kept], mesh.corner[kept], strict=True)]  # fmt: skip
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "gid", "corner"))
    head = f"ply\nformat ascii 1.0\nelement vertex {len(rows)}\n{names}element face 0\n"
    text = f"{head}property list uchar int vertex_indices\nend_header\n" + "\n".join(rows) + "\n"
    (tmp_path / "part.ply").write_text(text)
    done = octasplat(
        "material", scene, "-o", tmp_path / "out.ply", "--set", "roughness=0.9", "--mesh",
        tmp_path / "part.ply",
    )  # fmt: skip
    assert done.exit_code == 0 and "relight shows the materials" in done.output, done.output
    rough = scene_of(tmp_path / "out.ply").channels["roughness"][:, 0] == np.float32(0.9)
    assert set(np.flatnonzero(rough)) == set(mesh.gid[kept].astype(int))


def test_material_mask_selects_visible_gaussians(shiny_run, octasplat, tmp_path):
    """Blue is what the masked half of one picture then shows, and next to nothing of its other half."""
    mask = np.zeros((96, 128), np.uint8)
    mask[:, :64] = 255
    Image.fromarray(mask).save(tmp_path / f"{VIEW}.png")
    light = ("--environment", shiny_run / "environment.hdr", "--integrator", "path", "--samples", 4)
    pictures = []
    for name, inverse in (("in", ()), ("out", ("--inverse",))):
        done = octasplat(
            "material", shiny_run, "-o", tmp_path / name, "--set", "albedo=0,0,1", "--mask",
            tmp_path / f"{VIEW}.png", *inverse,
        )  # fmt: skip
        assert done.exit_code == 0, done.output
        assert octasplat("relight", tmp_path / name, *light, "-o", tmp_path / f"{name}_lit").exit_code == 0
        picture = read_image(tmp_path / f"{name}_lit" / f"{VIEW}.png")
        blue = (picture[..., 2] - picture[..., 0]).clip(0)
        pictures.append((blue[:, :30].mean(), blue[:, 34:].mean()))
    (left, rest), (other_left, other) = pictures
    assert left > 3 * rest and other > 3 * other_left


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("plain.ply", "--set", "roughness=1"), "plain.ply has no materials"),
        (("shiny.ply", "--set", "rough=1"), "--set rough: there is no such material"),
        (("shiny.ply", "--set", "roughness=2"), "--set roughness: "),
        (("shiny.ply", "--set", "roughness"), "NAME=VALUE"),
        (("shiny.ply", "--set", "albedo=red"), "--set albedo: write it as r,g,b"),
        (("shiny.ply", "--multiply", "metallic=-1"), "--multiply metallic: "),
        (("shiny.ply", "--set", "metallic=1", "--where", "glow > 1"), "the scene has no glow"),
        (("shiny.ply", "--set", "metallic=1", "--where", "x >"), "--where: 'x >' is no expression"),
        (("shiny.ply", "--set", "metallic=1", "--where", "x > 1e6"), "none of its"),
        (("shiny.ply", "--set", "metallic=1", "--mask", "a.png"), "masks need the folder of a run"),
    ],
)
def test_material_invalid_arguments_print_one_sentence(
    shiny_run, octasplat, tmp_path, monkeypatch, arguments, told
):
    monkeypatch.chdir(tmp_path)
    write_gaussian_ply(scene_of(shiny_run), tmp_path / "shiny.ply")
    write_gaussian_ply(scene_of(shiny_run).without_channels(["roughness"]), tmp_path / "plain.ply")
    (tmp_path / "a.png").write_text("a mask")
    done = octasplat("material", *arguments, "-o", "out.ply")
    assert done.exit_code == 1 and done.stderr.count("\n") == 1 and told in done.stderr, done.stderr
    assert not (tmp_path / "out.ply").exists()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ((), "Say what to change"),
        (("--set", "metallic=1", "--multiply", "metallic=2"), "metallic is set and multiplied"),
    ],
)
def test_material_without_change_is_usage_error(shiny_run, octasplat, tmp_path, arguments, told):
    done = octasplat("material", shiny_run, *arguments, "-o", tmp_path / "out.ply")
    assert done.exit_code == 2 and told in done.stderr.splitlines()[-1], done.stderr
    assert not (tmp_path / "out.ply").exists()


def test_material_unusable_output_or_mask_is_refused(shiny_run, octasplat, tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "file").write_text("x")
    (tmp_path / "view_000.png").write_text("no picture")
    (tmp_path / "other.png").write_text("of no photograph")
    for arguments, told in (
        (("-o", tmp_path / "there"), "is there already"),
        (("-o", tmp_path / "new", "--mask", tmp_path / "view_000.png"), "the mask cannot be read"),
        (("-o", tmp_path / "new", "--mask", tmp_path / "other.png"), "no photograph of this name"),
        (("-o", tmp_path / "new", "--mask", tmp_path / "missing.png"), "missing.png: cannot be read"),
    ):
        done = octasplat("material", shiny_run, "--set", "metallic=1", *arguments)
        assert done.exit_code == 1 and done.stderr.count("\n") == 1 and told in done.stderr, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other.png", "there", "view_000.png"]
