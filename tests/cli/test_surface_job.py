"""A job of the kind ``surface``: the bytes of the command, and options as they are asked for and kept."""

import json
import shutil
from pathlib import Path

import pytest
from pydantic import ValidationError

from octasplat.engine.dataset.image_sizes import ImageSizes
from octasplat.engine.operations.base import first_error
from octasplat.engine.operations.surface import MATERIAL_DEFAULTS, ROOM_DEFAULTS, SurfaceRequest
from octasplat.workers.worker.handlers import run_operation
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.task import Task

SURFACE = get_job_kind("surface")


def results_of(run: Path, attempt: Path, options: dict[str, object], **task: object) -> Path:
    """The results of a job that works on what a run publishes."""
    (attempt / "run").mkdir(parents=True)
    for name in SURFACE.source_files:
        if (run / name).exists():
            shutil.copy(run / name, attempt / "run" / name)
    config = json.loads((run / "config.json").read_text())
    (attempt / "run" / "config.json").write_text(json.dumps({**config, "scene": "a thing"}))
    dumped = SURFACE.resolve(options).model_dump(mode="json")
    run_operation(Task(attempt, json.loads(json.dumps(dumped)), threads=1, kind="surface", **task))
    return attempt / "results"


def test_job_with_photographs_gives_the_bytes_of_the_command(run, octasplat, tmp_path):
    done = octasplat(
        "surface", run.output, "-o", tmp_path / "surface.obj", "--resolution", 48, "--depth-side", 48,
        "--min-component", 0, "--texture-size", 64, "--max-triangles", "0.3k,100", "--threads", 1,
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    options = {
        "resolution": 48, "depth_side": 48, "min_component": 0, "texture_size": 64,
        "max_triangles": ["0.3k", 100], "format": "obj",
    }  # fmt: skip
    results = results_of(run.output, tmp_path / "attempt", options, scene=run.scene)
    names = sorted(path.name for path in results.iterdir())
    assert names == sorted(
        f"surface_{level}.{end}" for level in ("0.3k", "100") for end in ("mtl", "obj", "png")
    )
    for name in names:
        assert (results / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_job_without_photographs_takes_colors_from_the_scene(run, octasplat, tmp_path):
    few = ("--resolution", 32, "--depth-side", 32, "--threads", 1)
    copy = shutil.copytree(run.output, tmp_path / "run", ignore=shutil.ignore_patterns("cache"))
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps({**config, "scene": "a thing"}))
    assert octasplat("surface", copy, "-o", tmp_path / "a.glb", *few).exit_code == 0
    heard = []
    options = {"resolution": 32, "depth_side": 32}
    results = results_of(run.output, tmp_path / "attempt", options, progress=heard.append)
    assert (results / "surface.glb").read_bytes() == (tmp_path / "a.glb").read_bytes()
    assert any("not on this machine" in getattr(event, "message", "") for event in heard)
    assert heard[-1].message.startswith("Wrote results/surface.glb (")


def test_surface_of_moved_scene_ignores_photographs(run, octasplat, tmp_path):
    moved = tmp_path / "moved"
    assert octasplat("transform", run.output, "-o", moved, "--translate", 1, 0, 0).exit_code == 0
    heard = []
    options = {"resolution": 32, "depth_side": 32}
    with_them = results_of(moved, tmp_path / "a", options, scene=run.scene, progress=heard.append)
    assert any("other names or poses" in getattr(event, "message", "") for event in heard)
    without = results_of(moved, tmp_path / "b", options)
    assert (with_them / "surface.glb").read_bytes() == (without / "surface.glb").read_bytes()


def test_materials_bring_their_light(shiny_run, octasplat, tmp_path):
    few = (
        "--resolution",
        32,
        "--depth-side",
        32,
        "--texture-size",
        64,
        "--max-triangles",
        300,
        "--threads",
        1,
    )
    assert octasplat("surface", shiny_run, "--materials", "-o", tmp_path / "a.glb", *few).exit_code == 0
    options = {
        "materials": True, "resolution": 32, "depth_side": 32, "texture_size": 64, "max_triangles": 300,
    }  # fmt: skip
    results = results_of(shiny_run, tmp_path / "attempt", options)
    assert sorted(path.name for path in results.iterdir()) == ["environment.hdr", "surface.glb"]
    assert (results / "surface.glb").read_bytes() == (tmp_path / "a.glb").read_bytes()
    assert (results / "environment.hdr").read_bytes() == (shiny_run / "environment.hdr").read_bytes()


@pytest.mark.parametrize(
    ("name", "flag", "text", "value"),
    [
        ("fill_holes", "--fill-holes", "some", "all"),
        ("fill_holes", "--fill-holes", "-1", 3.5),
        ("max_triangles", "--max-triangles", "5q", ["5k", "60000"]),
        ("max_triangles", "--max-triangles", "3", ["4"]),
        ("max_triangles", "--max-triangles", "5k,5000", []),
    ],
)
def test_texts_are_read_alike_by_command_and_job(octasplat, tmp_path, name, flag, text, value):
    with pytest.raises(ValidationError) as refused:
        SURFACE.resolve({name: text})
    sentence = first_error(refused.value).removeprefix(f"{name}: ")
    (tmp_path / "none.ply").touch()
    done = octasplat("surface", tmp_path / "none.ply", "-o", tmp_path / "a.glb", flag, text)
    assert done.exit_code == 1 and done.stderr == f"Error: {flag}: {sentence}\n"
    joined = ",".join(map(str, value)) if isinstance(value, list) else str(value)
    as_text, as_json = SURFACE.resolve({name: joined} if joined else {}), SURFACE.resolve({name: value})
    assert as_text == as_json == SURFACE.resolve(as_json.model_dump(mode="json"))


def test_surface_job_presets_fill_unset_options():
    room = SURFACE.resolve({"room": True, "resolution": 99, "unseen": "open"})
    decided = {name: getattr(room, name) for name in ROOM_DEFAULTS}
    assert decided == {**ROOM_DEFAULTS, "resolution": 99, "unseen": "open"}
    lit = SURFACE.resolve({"materials": True, "max_triangles": "5k"})
    assert lit.texture_size == MATERIAL_DEFAULTS["texture_size"] and dict(lit.levels) == {"5k": 5000}
    plain = SURFACE.revise(room.model_dump(mode="json"), {"room": False})
    assert plain == SURFACE.resolve({"resolution": 99})
    boxed = SURFACE.resolve({"room": True, "box": [0, 0, 0, 1, 1, 1]})
    assert not boxed.unbounded and boxed.resolution == ROOM_DEFAULTS["resolution"]
    assert SURFACE.revise(boxed.model_dump(mode="json"), {"box": None}) == SURFACE.resolve({"room": True})
    request = SurfaceRequest(source="a.ply", output="b.glb", room=True, max_triangles=("5k", "60000"))
    assert request.refine_vertices and [path.name for path in request.outputs] == ["b_5k.glb", "b_60000.glb"]


def test_surface_job_color_fit_needs_photographs():
    for options, needed in (({}, True), ({"fit": False}, False), ({"materials": True}, False)):
        assert SURFACE.needs_photographs(SURFACE.resolve(options)) is needed


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"format": "ply", "texture_size": 128}, "a PLY holds no texture"),
        ({"format": "obj", "materials": True}, "materials are written as .glb"),
        ({"up": "z"}, "up: goes with materials"),
        ({"unbounded": True, "box": [0, 0, 0, 1, 1, 1]}, "contradict"),
        ({"voxel": 0.1, "resolution": 64}, "give one of them"),
        ({"box": [0, 0, 0, 1, 1, 0]}, "z0 < z1"),
    ],
)
def test_surface_job_contradictory_options_are_refused(options, told):
    with pytest.raises(ValidationError) as refused:
        SURFACE.resolve(options)
    assert told in first_error(refused.value)


def test_maps_and_levels_of_a_surface_have_ceilings():
    kind = get_job_kind("surface")
    options = kind.resolve({"depth_side": 8000, "texture_size": 4096, "max_triangles": "5k,50k"})
    amounts = {
        (found.path, found.resource): found.amount
        for found in kind.resource_demands(options, [ImageSizes(400, 300, 10)])
    }
    assert amounts == {
        ("depth_side", "side_px"): 8000,
        ("texture_size", "side_px"): 4096,
        ("depth_side", "render_pixels"): 10 * 8000 * 6000,
        ("max_triangles", "exports"): 2,
    }
