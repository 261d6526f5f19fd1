"""``octasplat info``: facts on a file or a run."""

import json
import shutil

import numpy as np
import pytest

from octasplat.engine.evaluate.scene_statistics import OPACITY_EDGES
from octasplat.engine.files.gaussian_ply import read_gaussian_ply, write_gaussian_ply
from octasplat.engine.operations.info import OPERATION, InfoRequest
from octasplat.engine.render.image_files import read_image
from octasplat.workers.worker.handlers import run_operation
from octasplat.workers.worker.job_kinds import get_job_kind
from octasplat.workers.worker.task import Task


def test_info_of_file_matches_gaussians(run, octasplat, tmp_path):
    gaussians, _ = read_gaussian_ply(run.output / "scene.ply")
    count = len(gaussians)
    gaussians = gaussians.with_channels({"roughness": np.ones((count, 1), np.float32)})
    gaussians.means_world[0] = (1000, 0, 0)  # a stray
    write_gaussian_ply(gaussians, tmp_path / "scene.ply")
    result = octasplat("info", tmp_path / "scene.ply", "--up", "z", "--json", "--rays")
    assert result.exit_code == 0, result.output
    facts = json.loads(result.stdout)
    assert facts["count"] == count and facts["sh_degree"] == gaussians.sh_degree
    assert facts["channels"] == {"roughness": 1}
    assert facts["box"]["high_world"][0] == 1000 and facts["box_solid"]["high_world"][0] < 100
    expected = np.histogram(gaussians.opacities, np.array(OPACITY_EDGES))[0]
    assert facts["opacity_counts"] == expected.tolist() and sum(expected) == count
    assert facts["scale_quantiles"][2] == pytest.approx(np.median(gaussians.scales.max(axis=1)), rel=1e-6)
    assert facts["up_world"] == [0, 0, 1] and facts["photographs"] is None
    assert 0 < facts["hits"]["mean"] <= facts["hits"]["p95"] and 0 < facts["hits"]["share"] <= 1
    assert "hits" not in json.loads(octasplat("info", tmp_path / "scene.ply", "--json").stdout)
    words = octasplat("info", tmp_path / "scene.ply").stdout
    assert f"{count:,} Gaussians" in words and "roughness (1)" in words and "\x1b" not in words


def test_info_of_run_has_views_and_thumbnail(run, octasplat, tmp_path):
    result = octasplat("info", run.output, "--picture", tmp_path / "look.png")
    assert result.exit_code == 0, result.output
    assert "a run of 8 photographs" in result.stdout and "of the photographs" in result.stdout
    assert read_image(tmp_path / "look.png").std() > 0.02


def test_info_not_a_scene_is_refused(octasplat, tmp_path):
    result = octasplat("info", tmp_path / "none.ply")
    assert result.exit_code == 1 and result.stderr.count("\n") == 1 and "none.ply" in result.stderr
    (tmp_path / "none.ply").touch()
    result = octasplat("info", tmp_path / "none.ply", "--picture", tmp_path / "look")
    assert result.exit_code == 1 and "--picture: " in result.stderr and "no name of a .png" in result.stderr


def test_info_job_and_request_match_command(run, octasplat, tmp_path):
    done = octasplat("info", run.output, "--json", "--picture", tmp_path / "look.png", "--threads", 1)
    facts = json.loads(done.stdout)
    (tmp_path / "attempt" / "run").mkdir(parents=True)
    kind = get_job_kind("info")
    for name in kind.source_files:
        if (run.output / name).exists():
            shutil.copy(run.output / name, tmp_path / "attempt" / "run" / name)
    heard = []
    options = kind.resolve({}).model_dump(mode="json")
    run_operation(Task(tmp_path / "attempt", options, threads=1, progress=heard.append, kind="info"))
    results = tmp_path / "attempt" / "results"
    assert sorted(path.name for path in results.iterdir()) == ["info.json", "picture.png"]
    assert json.loads((results / "info.json").read_text()) == {**facts, "source": "the result"}
    assert (results / "picture.png").read_bytes() == (tmp_path / "look.png").read_bytes()
    assert any("the result: " in getattr(event, "message", "") for event in heard)

    result = OPERATION.run(
        InfoRequest(source=run.output, output=tmp_path / "facts.json", rays=True), threads=1
    )
    assert json.loads((tmp_path / "facts.json").read_text()) == facts
    assert result.scene.count == facts["count"] and result.files == (tmp_path / "facts.json",)
    assert result.lines() == tuple(octasplat("info", run.output, "--rays").stdout.splitlines())
