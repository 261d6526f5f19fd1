"""Results of a job on a machine without its photographs: what works there, and what asks for them and how."""

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import trimesh

from octasplat.engine.core.events import Event, Warned
from octasplat.engine.render.image_files import read_image
from octasplat.engine.runs.config import resolve_config
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.reconstruct_handler import reconstruct
from octasplat.workers.worker.task import Task

SETTINGS = (
    "iterations=60",
    "rays_per_batch=256",
    "max_gaussians=600",
    "initial_points=300",
    "probe_rays=256",
    "ssim_patch_side=16",
)


@dataclass(frozen=True)
class Results:
    """What a job published, and a copy of the photographs that it never saw."""

    folder: Path
    photographs: Path
    warnings: tuple[str, ...]


@pytest.fixture(scope="module")
def results(scene, tmp_path_factory) -> Results:
    """Made by the program of the job kind itself, in a folder that is gone afterwards."""
    root = tmp_path_factory.mktemp("job")
    shutil.copytree(scene, root / "dataset")
    config = resolve_config(
        "fast", settings={"test_every": 4, "max_side": 48, "exports": ("viewer.glb",)}, assignments=SETTINGS
    )
    options = get_job_kind("reconstruct").options.model_validate(config.model_dump(mode="json"))
    left = root / "attempt" / "run" / "config.json"  # by an attempt of another version
    left.parent.mkdir(parents=True)
    left.write_text(json.dumps({"scene": "elsewhere", "reconstruction": {"a_later_setting": 1}}))
    heard: list[Event] = []
    reconstruct(
        Task(
            root / "attempt",
            options.model_dump(mode="json"),
            root / "dataset",
            "still life",
            threads=1,
            progress=heard.append,
        )
    )
    warnings = tuple(event.message for event in heard if isinstance(event, Warned))
    downloaded = tmp_path_factory.mktemp("downloaded") / "results"
    shutil.copytree(root / "attempt" / "results", downloaded)
    shutil.rmtree(root)
    return Results(downloaded, scene, warnings)


@pytest.mark.exhaustive
def test_retry_with_incompatible_state_restarts_with_warning(results):
    (told,) = [warning for warning in results.warnings if "begins anew" in warning]
    assert (
        "config.json" in told
        and json.loads((results.folder / "metrics.json").read_text())["iterations"] == 60
    )


def test_downloaded_run_renders_views_without_photographs(results, octasplat, tmp_path):
    result = octasplat("render", results.folder, "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["view_000.png", "view_004.png"]
    for path in (tmp_path / "out").iterdir():
        evaluated = read_image(results.folder / "renders" / path.name)
        assert np.abs(read_image(path) - evaluated).max() <= 2 / 255


@pytest.mark.parametrize(("side", "shape"), [(24, (18, 24, 3)), (64, (48, 64, 3)), (640, (48, 64, 3))])
def test_downloaded_run_view_sizes_follow_photographs(results, octasplat, tmp_path, side, shape):
    for name, more in (("without", ()), ("with", ("--dataset", results.photographs))):
        result = octasplat(
            "render", results.folder, "-o", tmp_path / name, "--views", "train", "--max-side", side, *more
        )
        assert result.exit_code == 0, result.output
    names = sorted(path.name for path in (tmp_path / "with").iterdir())
    assert len(names) == 6 and sorted(path.name for path in (tmp_path / "without").iterdir()) == names
    for name in names:
        alone = read_image(tmp_path / "without" / name)
        assert alone.shape == shape
        assert np.abs(alone - read_image(tmp_path / "with" / name)).max() <= 2 / 255


def test_downloaded_run_turntable_matches_original(results, octasplat, tmp_path):
    turn = ("--turntable", "--frames", 2, "--width", 32, "--height", 24)
    for name, more in (("without", ()), ("with", ("--dataset", results.photographs))):
        result = octasplat("render", results.folder, "-o", tmp_path / name, *turn, *more)
        assert result.exit_code == 0, result.output
    for name in ("frame_0000.png", "frame_0001.png"):
        assert (tmp_path / "without" / name).read_bytes() == (tmp_path / "with" / name).read_bytes()


def test_downloaded_run_surface_matches_original(results, octasplat, tmp_path):
    size = ("--resolution", 32, "--depth-side", 48, "--min-component", 0, "--quiet")
    for name, more in (("without", ()), ("with", ("--dataset", results.photographs))):
        result = octasplat("surface", results.folder, "-o", tmp_path / f"{name}.ply", *size, *more)
        assert result.exit_code == 0, result.output
    without, with_them = (
        trimesh.load(tmp_path / f"{name}.ply", process=False) for name in ("without", "with")
    )
    assert np.array_equal(without.vertices, with_them.vertices)
    assert np.array_equal(without.faces, with_them.faces)
    # Colors are fitted to the photographs where there are any, to renders of the same views elsewhere.
    colors = (mesh.visual.vertex_colors.astype(float) for mesh in (without, with_them))
    assert 0 < np.abs(next(colors) - next(colors)).mean() < 25


def test_evaluate_without_photographs_names_option(results, octasplat, tmp_path):
    before = {path.name for path in results.folder.iterdir()}
    result = octasplat("evaluate", results.folder)
    assert result.exit_code == 1
    assert "still life" in result.stderr and "--dataset FOLDER" in result.stderr
    assert result.stderr.count("\n") == 1
    assert {path.name for path in results.folder.iterdir()} == before


def test_evaluation_with_the_photographs_gives_the_same_figures(results, octasplat, tmp_path):
    copy = tmp_path / "results"
    shutil.copytree(results.folder, copy)
    result = octasplat("evaluate", copy, "--dataset", results.photographs, "--threads", 1)
    assert result.exit_code == 0, result.output
    assert result.stderr == ""
    before, after = (json.loads((folder / "metrics.json").read_text()) for folder in (results.folder, copy))
    assert after["views"] == before["views"]


def test_evaluate_with_other_photographs_warns(results, octasplat, tmp_path):
    copy, others = tmp_path / "results", tmp_path / "others"
    shutil.copytree(results.folder, copy)
    shutil.copytree(results.photographs, others)
    shutil.copy(others / "images/view_001.png", others / "images/view_004.png")
    result = octasplat("evaluate", copy, "--dataset", others, "--threads", 1)
    assert result.exit_code == 0, result.output
    assert "Warning:" in result.stderr and "view_004.png with another file" in result.stderr


def test_downloaded_poses_are_used_for_bare_photographs(results, octasplat, tmp_path):
    copy, bare = tmp_path / "results", tmp_path / "bare"
    shutil.copytree(results.folder, copy)
    shutil.copytree(results.photographs / "sparse/0", copy / "poses")
    shutil.copytree(results.photographs / "images", bare / "images")
    result = octasplat("evaluate", copy, "--dataset", bare, "--threads", 1)
    assert result.exit_code == 0, result.output
    assert result.stderr == ""


@pytest.mark.parametrize("command", ["render", "surface"])
def test_former_results_require_photographs_option(results, octasplat, tmp_path, command):
    copy = tmp_path / "results"
    shutil.copytree(results.folder, copy)
    (copy / "views.json").unlink()
    result = octasplat(command, copy, "-o", tmp_path / "out.glb")
    assert result.exit_code == 1
    assert "--dataset FOLDER" in result.stderr
    assert not (tmp_path / "out.glb").exists()


def test_damaged_views_are_named(results, octasplat, tmp_path):
    copy = tmp_path / "results"
    shutil.copytree(results.folder, copy)
    text = (copy / "views.json").read_text()
    (copy / "views.json").write_text(text[: len(text) // 2])
    result = octasplat("render", copy, "-o", tmp_path / "out")
    assert result.exit_code == 1
    assert str(copy / "views.json") in result.stderr and result.stderr.count("\n") == 1
