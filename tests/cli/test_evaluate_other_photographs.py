"""``octasplat evaluate OUT --other-dataset FOLDER``: photographs that are not the run's are measured."""

import json
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from octasplat.engine.render.image_files import read_image, write_png
from octasplat.workers.worker.handlers import run_operation
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.task import Task


def part_of(scene: Path, folder: Path, wanted: set[str], *, points: bool = False) -> Path:
    """A folder with some photographs of a scene and their model."""
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    for image in list(model.images.values()):
        if image.name not in wanted:
            model.deregister_frame(image.frame_id)
    if not points:
        for number in list(model.points3D):
            model.delete_point3D(number)
    (folder / "sparse" / "0").mkdir(parents=True)
    (folder / "images").mkdir()
    model.write(folder / "sparse" / "0")
    for name in wanted:
        shutil.copy(scene / "images" / name, folder / "images" / name)
    return folder


def test_evaluate_on_other_folder_matches_run_metrics(run, octasplat, tmp_path):
    own = (run.output / "metrics.json").read_bytes()
    held_out = set(run.metrics()["views"])
    some = sorted(path.name for path in (run.scene / "images").iterdir())[:3]
    others = part_of(run.scene, tmp_path / "others", {*held_out, *some})
    result = octasplat("evaluate", run.output, "--other-dataset", others)
    assert result.exit_code == 0, result.output
    assert "Warning" not in result.output
    measured = run.output / "on" / "others"
    assert str(measured / "report.html") in result.output
    metrics = json.loads((measured / "metrics.json").read_text())
    assert set(metrics["views"]) == {*held_out, *some}
    for name in held_out:
        assert metrics["views"][name] == run.metrics()["views"][name]
    pictures = sorted(path.stem for path in (measured / "renders").iterdir())
    assert pictures == sorted(Path(name).stem for name in metrics["views"])
    name = Path(sorted(held_out)[0]).stem
    own_picture = read_image(run.output / "renders" / f"{name}.png")
    assert (read_image(measured / "renders" / f"{name}.png") == own_picture).all()
    assert (run.output / "metrics.json").read_bytes() == own
    # The same as a job: its results are those figures.
    kind = get_job_kind("evaluate")
    shutil.copytree(run.output, tmp_path / "attempt" / "run", ignore=shutil.ignore_patterns("on", "cache"))
    options = kind.for_other_photographs(kind.resolve({}))
    dumped = options.model_dump(mode="json")
    run_operation(Task(tmp_path / "attempt", dumped, scene=others, threads=1, kind="evaluate"))
    results = tmp_path / "attempt" / "results"
    assert json.loads((results / "metrics.json").read_text())["views"] == metrics["views"]
    assert sorted(path.name for path in results.iterdir()) == ["metrics.json", "renders", "report.html"]
    assert len(list((results / "renders").iterdir())) == len(pictures)

    same_name = part_of(run.scene, tmp_path / "elsewhere" / "others", {some[1]})
    result = octasplat("evaluate", run.output, "--other-dataset", same_name)
    assert result.exit_code == 1
    assert str(measured) in result.output and "rename" in result.output
    assert json.loads((measured / "metrics.json").read_text()) == metrics


def test_evaluate_on_single_view_succeeds(run, octasplat, tmp_path):
    name = min(path.name for path in (run.scene / "images").iterdir())
    result = octasplat(
        "evaluate", run.output, "--other-dataset", part_of(run.scene, tmp_path / "one", {name})
    )
    assert result.exit_code == 0, result.output
    assert list(json.loads((run.output / "on" / "one" / "metrics.json").read_text())["views"]) == [name]


@pytest.mark.parametrize("content", ["nothing", "images alone"])
def test_evaluate_on_unusable_folder_is_refused(run, octasplat, tmp_path, content):
    folder = tmp_path / "odd"
    if content == "images alone":
        shutil.copytree(run.scene / "images", folder / "images")
    result = octasplat("evaluate", run.output, "--other-dataset", folder)
    assert result.exit_code == 1 and str(folder) in result.output
    assert not (run.output / "on" / "odd").exists()


def test_invalid_ground_truth_file_is_refused(run, octasplat, tmp_path):
    name = min(path.name for path in (run.scene / "images").iterdir())
    folder = part_of(run.scene, tmp_path / "odd_truth", {name})
    (folder / "truth.json").write_text('{"answer": 42}')
    result = octasplat("evaluate", run.output, "--other-dataset", folder)
    assert result.exit_code == 1 and str(folder / "truth.json") in result.output
    assert not (run.output / "on" / "odd_truth").exists()


def moved_world(scene: Path, folder: Path, shift: float) -> Path:
    """The photographs of a scene whose model was moved to another world."""
    shutil.copytree(scene / "images", folder / "images")
    model = pycolmap.Reconstruction(scene / "sparse" / "0")
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), np.array([shift, 0.0, 0.0])))
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write(folder / "sparse" / "0")
    for image in (folder / "images").iterdir():  # other files than those of the run, which are known again
        write_png(image.with_suffix(".png"), read_image(image)[::-1])
    return folder


def test_photographs_of_another_world_are_warned_of(run, octasplat, tmp_path):
    folder = moved_world(run.scene, tmp_path / "other_world", 1000.0)
    result = octasplat("evaluate", run.output, "--other-dataset", folder)
    assert result.exit_code == 0, result.output
    words = " ".join(result.output.split())
    assert "scene extents from the cameras of the run" in words
    assert "Warning" in words and "name a folder whose model" in words
    report = (run.output / "on" / folder.name / "report.html").read_text()
    assert "name a folder whose model" in report
